"""What a notebook's file keeps of a live view, for when its kernel has gone."""

import base64
import os
from typing import Any

from .page import fill

Bundle = tuple[dict[str, Any], dict[str, Any]]
"""What a notebook stores of an output, by MIME type, and words about it."""
WIDGET_MIME = "application/vnd.jupyter.widget-view+json"


def static_views() -> bool:
    """Whether live views should leave only a picture in the notebook.

    True with ``GSNB_VIEW=static`` (the notebook is executed to be stored: a widget without its
    kernel shows nothing) and with ``GSNB_SMOKE=1`` (a quick test run).
    """
    return os.environ.get("GSNB_VIEW") == "static" or os.environ.get("GSNB_SMOKE", "0") not in (
        "",
        "0",
    )


def with_stored(
    bundle: Any,
    kind: str,
    content: bytes,
    text: str,
    words: dict[str, Any],
) -> Bundle:
    """A widget's mime bundle with a picture for readers of the stored notebook; only that with
    ``static_views()``.

    Args:
        bundle: The widget's own, with or without metadata.
        kind: MIME type of the picture.
        content: The picture's file.
        text: For readers without pictures.
        words: Metadata of the picture: its description for screen readers, ``alt``, its
            ``width``, pixels, and what else a page that shows it says.
    """
    data = dict(bundle[0] if isinstance(bundle, tuple) else bundle or {})
    if static_views():
        data.pop(WIDGET_MIME, None)
    data[kind] = base64.b64encode(content).decode("ascii")
    data["text/plain"] = text
    return data, {kind: words}


class LiveOutput:
    """Shows what ``_repr_mimebundle_`` gives as two outputs: the widget, and what is stored of it.

    JupyterLab prefers a widget to every other form in the same output, also when its kernel has
    gone and nothing can be shown. The second output is hidden while the first one is alive.
    """

    _repr_mimebundle_: Any
    _stored_output: Any = None

    def _ipython_display_(self) -> None:
        from IPython.display import display

        if static_views():
            raise NotImplementedError  # IPython then asks for the mime bundle
        data, words = self._repr_mimebundle_()
        display({WIDGET_MIME: data[WIDGET_MIME]}, raw=True)
        self._stored_output = display(_to_store(data, words), raw=True, display_id=True)

    def store_output(self) -> None:
        """Draw again, and put that in the place of what was stored, where a notebook shows it."""
        data, words = self._repr_mimebundle_()
        if self._stored_output is not None:
            self._stored_output.update(_to_store(data, words), raw=True)


def _to_store(
    data: dict[str, Any],
    words: dict[str, Any],
) -> dict[str, str]:
    return {
        "text/html": fill("stored.html", data=data, words=words),
        "text/plain": data["text/plain"],
    }
