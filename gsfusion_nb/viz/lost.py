"""The line of a panel that says what to do when its kernel has gone."""

import anywidget

from .front_end import joined

_CSS = """
.gsnb-lost:empty { display: none; }
.gsnb-lost { margin: 6px 0; padding: 4px 8px; border-left: 3px solid #d1495b; }
"""


class LostNotice(anywidget.AnyWidget):
    """Empty while the kernel lives; after a restart or a shutdown it tells to run the cell again.

    It also gives the sliders beside it their labels as names for screen readers, which ipywidgets does not.
    """

    _esm = joined(("lost", "notice"))
    _css = _CSS
