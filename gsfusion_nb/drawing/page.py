"""Elements of HTML pages: pictures with captions and colour bars, and graphs (``templates/parts.html``)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from . import pictures
from .curves import Numbers, curve_figure, figure_svg

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


@dataclass(frozen=True, kw_only=True)
class PagePicture:
    """A picture that is stored in the page."""

    src: str
    """The picture as a data URI."""
    width: int
    height: int
    alt: str
    caption: str
    bar: ColourBar | None = None


@dataclass(frozen=True)
class PageGraph:
    """A graph that is stored in the page."""

    title: str
    svg: str
    """An ``<svg>`` element that takes the page's colours."""


def page_picture(
    image: pictures.ImageLike, caption: str, *, alt: str = "", bar: ColourBar | None = None
) -> PagePicture:
    """A picture for a page, at most ``PICTURE_WIDTH`` wide; ``alt`` is the caption if it is not given."""
    small = pictures.fit_width(image, PICTURE_WIDTH)
    height, width = small.shape[:2]
    src = pictures.data_uri(small)
    return PagePicture(src=src, width=width, height=height, alt=alt or caption, caption=caption, bar=bar)


def page_graph(title: str, x: Numbers, series: Mapping[str, Numbers], **options: Any) -> PageGraph:
    """A graph for a page; options of ``curve_figure``."""
    return PageGraph(title, figure_svg(curve_figure(x, series, **options), title))
