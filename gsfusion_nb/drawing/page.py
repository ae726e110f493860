"""Parts of HTML pages that many pages share: the page itself, pictures with captions, colour bars, graphs."""

from collections.abc import Mapping
from html import escape
from typing import Any

from . import pictures
from .curves import Numbers, curve_figure, figure_svg

PICTURE_WIDTH = 960
"""Pictures are stored no wider than this, pixels; a report of six views stays at a few megabytes."""


def page_html(title: str, body: str) -> str:
    """A whole page in the look of the report, with click-to-enlarge pictures."""
    from .page_style import SCRIPT, STYLE

    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n<link rel="icon" href="data:,">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        '<dialog id="zoom"><img alt=""></dialog>\n'
        f"<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def figure(image: pictures.ImageLike, alt: str, caption: str) -> str:
    """An image and its caption, to stand in a ``<figure>``."""
    small = pictures.fit_width(image, PICTURE_WIDTH)
    height, width = small.shape[:2]
    return (
        f'<img src="{pictures.data_uri(small)}" alt="{escape(alt)}" width="{width}" height="{height}">'
        f"<figcaption>{escape(caption)}</figcaption>"
    )


def colour_bar(colours: str, low: str, high: str) -> str:
    """A colour map as a bar with its two ends written under it."""
    stops = ",".join(pictures.colour_stops(colours))
    return (
        f'<div class="bar" style="background:linear-gradient(90deg,{stops})"></div>'
        f'<div class="ends"><span>{low}</span><span>{high}</span></div>'
    )


def chart(title: str, x: Numbers, series: Mapping[str, Numbers], **options: Any) -> str:
    """A card with a graph; options of ``curve_figure``."""
    svg = figure_svg(curve_figure(x, series, **options), title)
    return f'<div class="card chart"><h3>{escape(title)}</h3>{svg}</div>'
