"""Elements of HTML pages: pictures with captions and colour bars, and graphs
(``templates/parts.html``)."""

import base64
import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from . import pictures
from .curves import Numbers, curve_figure, figure_png
from .encoding import data_uri

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure


PICTURE_WIDTH = 960
"""Largest width of a stored picture, pixels; a report with six views has a few megabytes."""


@dataclass(frozen=True, kw_only=True)
class ColourBar:
    """A colour map with the values at its two ends."""

    colours: str
    """Name of the colour map, as in ``drawing.pictures``."""
    low: str
    high: str

    @property
    def stops(self) -> list[str]:
        """Colours along the bar, "#rrggbb"."""
        return pictures.colour_stops(self.colours)


@dataclass(frozen=True)
class PageGraph:
    """A graph that is stored in the page."""

    title: str
    figure: "Figure"

    @property
    def src(self) -> str:
        """The figure as text for an ``<img>``, readable on a light and on a dark page."""
        self.figure.set_dpi(200)
        return f"data:image/png;base64,{base64.b64encode(figure_png(self.figure)).decode('ascii')}"


def page_picture(
    image: pictures.ImageLike,
    caption: str,
    *,
    alt: str = "",
    bar: ColourBar | None = None,
) -> dict[str, Any]:
    """A picture that is stored in the page, for ``parts.html``: at most ``PICTURE_WIDTH`` wide.

    Args:
        image: RGB. [H, W, 3]
        caption: Below it; also its description, unless ``alt`` is given.
        bar: The scale of its colours.
    """
    small = pictures.fit_width(image, PICTURE_WIDTH)
    height, width = small.shape[:2]
    src = data_uri(small)
    return {
        "src": src,
        "width": width,
        "height": height,
        "alt": alt or caption,
        "caption": caption,
        "bar": bar,
    }


def page_graph(
    title: str,
    x: Numbers,
    series: Mapping[str, Numbers],
    **options: Any,
) -> PageGraph:
    """A graph for a page; options of ``curve_figure``."""
    return PageGraph(title, curve_figure(x, series, **options))


def fill(template: str, **values: Any) -> str:
    """The text of a filled-in template, without line breaks at its ends.

    Args:
        template: File name in ``templates/``.
        values: The template's variables.

    Raises:
        jinja2.UndefinedError: a variable of the template was not given.
    """
    return str(_environment().get_template(template).render(**values)).strip()


def html_table(
    rows: Iterable[Sequence[str]],
    *,
    heads: Sequence[str] = (),
    foot: str = "",
    name: str = "",
    style: str = "",
    cell_style: str = "",
    head_style: str | None = None,
) -> str:
    """A table for a notebook's output. Texts are escaped; a cell that is HTML is ``Markup``.

    Args:
        rows: Cells of each row.
        heads: Headings of the columns, or none.
        foot: One line under the rows, across all columns.
        name: CSS class of the table.
        style: CSS of the table.
        cell_style: CSS of every cell.
        head_style: CSS of every heading; that of the cells by default.
    """
    values = {"name": name, "style": style, "cell_style": cell_style}
    values["head_style"] = cell_style if head_style is None else head_style
    return fill("table.html", rows=rows, heads=heads, foot=foot, **values)


@functools.cache
def _environment() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("gsfusion_nb.drawing"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
