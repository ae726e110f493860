"""Stored pictures of a notebook in a page."""

import io
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from PIL import Image

_PHONE_PX = 400
"""A picture wider than this is scaled down on a phone, and what is written in it with it."""


def picture_html(
    address: str,
    content: bytes,
    metadata: Mapping[str, Any],
    suffix: str,
) -> str:
    """An image with its size, so that the page does not move when it is loaded.

    A wide one is a link to itself, to be enlarged, and its words stand below it on a narrow page:
    the labels in it are then too small to be read.
    """
    width, height = Image.open(io.BytesIO(content)).size
    wide = int(metadata.get("width", width))
    words = escape(str(metadata.get("alt", "")) or "picture")
    drawing = ' class="gsnb-figure"' if suffix == "png" else ""
    image = (
        f'<img{drawing} src="{address}" width="{wide}" height="{round(wide * height / width)}" '
        f'loading="lazy" alt="{words}">'
    )
    if wide <= _PHONE_PX:
        return image
    # screen readers have the same words from the image
    caption = f'<figcaption aria-hidden="true">{words}</figcaption>'
    return f'<figure class="gsnb-wide"><a href="{address}">{image}</a>{caption}</figure>'


def steps_html(pictures: Sequence[tuple[str, bytes]], metadata: Mapping[str, Any]) -> str:
    """The stills of a stepper: each picture (address, content), with its words as text beside it,
    or below it on a narrow page."""
    width = int(metadata["width"]) // 2
    parts = []
    for (address, content), step in zip(pictures, metadata["steps"], strict=True):
        across, down = Image.open(io.BytesIO(content)).size
        title = escape(step["title"])
        rows = (
            "".join(f"<td>{escape(cell, quote=False)}</td>" for cell in row)
            for row in step["numbers"]
        )
        table = "".join(f"<tr>{row}</tr>" for row in rows)
        parts.append(
            f'<figure class="gsnb-step"><img class="gsnb-figure" src="{address}" width="{width}" '
            f'height="{round(width * down / across)}" loading="lazy" alt="{title}">'
            f"<figcaption><p>{title}</p>"
            f"<p><code>{escape(step['place'], quote=False)}</code></p>"
            f"<pre>{escape(step['code'], quote=False)}</pre>"
            f"<table>{table}</table></figcaption></figure>"
        )
    return "".join(parts)


def cut_steps(still: bytes, n_steps: int) -> list[bytes]:
    """The pictures in a stepper's still, which are its left half, from top to bottom."""
    image = Image.open(io.BytesIO(still))
    width = image.width // 2
    height = image.height // n_steps
    pictures = []
    for k in range(n_steps):
        part = io.BytesIO()
        image.crop((0, k * height, width, (k + 1) * height)).save(part, "PNG", optimize=True)
        pictures.append(part.getvalue())
    return pictures
