"""Panels that a page of the book computes by itself, without a kernel: their HTML and their
scripts."""

import json
import re
import shlex
from html import escape
from pathlib import Path

from .live_data import panel_data

PANELS = {
    "2e0433dd": "pixel",
    "5e44bd16": "fusion",
    "ac2f6900": "quadtree",
    "99b60ff8": "seeds",
    "s13": "gaussian",
    "s29": "order",
    "s35": "stack",
    "g45": "paint",
    "m34": "room",
}
"""Cell of a notebook -> the panel below it."""
TRY = {
    "gaussian": (
        "Drag the Gaussian by its middle, or by the end of an axis, and watch the 2x2 matrix and "
        "its ellipse. Bring it near and lean it: the exact points leave the ellipse."
    ),
    "order": (
        "Swap the two Gaussians. Their alphas stay, and the colour of the ringed pixel changes, "
        "because the one in front takes light from the other."
    ),
    "stack": (
        "Press a pixel of the map. Its Gaussians are listed from near to far: the light that is "
        "left falls, and a large alpha behind little light weighs nothing."
    ),
    "paint": (
        "Every step is a picture, a gradient by hand and Adam. Press the painting to choose a "
        "Gaussian, pull it away, and take single steps: the arrow is minus its gradient."
    ),
    "seeds": "Move the threshold and the largest size, then look at the Gaussians from the side.",
    "room": (
        "Press Play, or move time. The dots fall below the dotted line where the map forgets a "
        "frame, and rise again with the passes over all keyframes."
    ),
}
"""What a reader of a chapter is told to try, for panels whose HTML does not say it."""
FOLDER = Path(__file__).parent / "live"
POSTERS = FOLDER / "posters"
"""What a panel shows before its script runs; ``python -m book.posters`` makes them."""
COMMON = ("formulas", "splats", "gradients", "maps", "panel", "open")
"""Scripts that all panels share."""
_MARK = re.compile(r"\{\{(\w+) (.+?)\}\}")
_NAME = re.compile(r"^(?:async )?(?:const|function|class) (\w+)", re.MULTILINE)
_FIRST_PICTURE = ' fetchpriority="high"'


def panel_html(name: str, root: str = "../", *, chapter: bool = True, first: bool = False) -> str:
    """A panel: its posters, controls and words, which its script makes live.

    Args:
        name: Of the panel.
        root: Way from the page to the root of the book.
        chapter: With what to try; the page of the panels says it in its text.
        first: Its poster is the first picture of the page, so it is loaded at once.
    """
    text = (FOLDER / f"{name}.html").read_text(encoding="utf-8")
    body = _MARK.sub(lambda match: _piece(name, match[1], shlex.split(match[2]), root, first), text)
    lead = f"<p><b>Try it in this page.</b> {TRY[name]}</p>" if chapter and name in TRY else ""
    off = "<noscript><p>These are still pictures. They react where JavaScript is on.</p></noscript>"
    return (
        f'<section class="gsnb-live" id="live-{name}" data-live="{name}" '
        f'aria-label="Panel: {escape(name)}">{lead}{body}{off}</section>'
        f'<script defer src="{root}_static/live_panels.js"></script>'
    )


def cell_panel_html(cell: str) -> str:
    """The panel below a cell of a notebook; "" for most cells."""
    return panel_html(PANELS[cell]) if cell in PANELS else ""


def _piece(panel: str, kind: str, values: list[str], root: str, first: bool) -> str:
    """HTML of one mark of a panel's text."""
    name = values[0]
    if kind == "picture":
        width, height = values[1].split("x")
        loading = _FIRST_PICTURE if first else ' loading="lazy"'
        return (
            f'<div class="gsnb-live-stage" data-picture="{name}">'
            f'<img src="{root}_static/posters/{panel}_{name}.webp" width="{width}" '
            f'height="{height}" alt="{escape(values[2])}"{loading}></div>'
        )
    if kind == "chart":
        width, height = values[1].split("x")
        return _chart(panel, name, f"aspect-ratio: {width} / {height}")
    if kind == "table":
        return _chart(panel, name, f"min-height: {values[1]}em")
    if kind == "slider":
        low, high, step, start, label = values[1:]
        return (
            f'<label><span>{escape(label)}</span><input type="range" name="{name}" min="{low}" '
            f'max="{high}" step="{step}" value="{start}" disabled><span></span></label>'
        )
    if kind == "choice":
        options = "".join(f"<option>{escape(words)}</option>" for words in values[2:])
        label = f"<span>{escape(values[1])}</span>"
        return f'<label>{label}<select name="{name}" disabled>{options}</select></label>'
    if kind == "check":
        box = f'<input type="checkbox" name="{name}" disabled>'
        return f'<label class="gsnb-live-check">{box}<span>{escape(values[1])}</span></label>'
    if kind == "button":
        return f'<button type="button" name="{name}" disabled>{escape(values[1])}</button>'
    marks = "picture, chart, table, slider, choice, check, button"
    raise ValueError(f"{panel}.html: no mark {kind!r}; there are {marks}")


def _chart(panel: str, name: str, style: str) -> str:
    """The place of a graph or table, with its poster in it."""
    poster = POSTERS / f"{panel}_{name}.html"
    drawn = poster.read_text(encoding="utf-8") if poster.exists() else ""
    return f'<div class="gsnb-live-chart" data-chart="{name}" style="{style}">{drawn}</div>'


def common_script() -> str:
    """What all panels share, once for a page: equations, controls, and what opens the panels."""
    parts = [(FOLDER / f"{part}.js").read_text(encoding="utf-8") for part in COMMON]
    names = ", ".join(_common_names())
    return f"globalThis.gsnbLive ??= (() => {{\n{''.join(parts)}return {{ {names} }};\n}})();\n"


def panel_script(name: str) -> str:
    """What draws a panel: its own part and its numbers."""
    own = (FOLDER / f"{name}.js").read_text(encoding="utf-8")
    names = [word for word in _common_names() if re.search(rf"\b{word}\b", own)]
    data = f"const DATA = {json.dumps(panel_data(name), separators=(',', ':'))};\n"
    return (
        f"(() => {{\nconst {{ {', '.join(names)} }} = globalThis.gsnbLive;\n{data}{own}"
        f"start(document.querySelector('#live-{name}'));\n}})();\n"
    )


def _common_names() -> list[str]:
    """What the shared scripts define."""
    text = "".join((FOLDER / f"{part}.js").read_text(encoding="utf-8") for part in COMMON)
    return _NAME.findall(text)
