"""The stored outputs of a notebook's cell as HTML, with its pictures as files."""

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from .places import Places

_PICTURES = {"image/png": "png", "image/jpeg": "jpg"}
_SOURCE = re.compile(r'href="(?:\.\./)+([\w/.-]+)#line=(\d+)"')


@dataclass(kw_only=True)
class Files:
    """Files that belong to a page, by their names relative to it."""

    folder: str
    """Where they are put, relative to the page."""
    contents: dict[str, bytes] = field(default_factory=dict)

    def add(self, name: str, content: bytes) -> str:
        """Keep a file; its address relative to the page."""
        address = f"{self.folder}/{name}"
        self.contents[address] = content
        return address


def outputs_html(cell: Mapping[str, Any], page: str, places: Places, files: Files) -> list[str]:
    """HTML of each output of a cell; what it printed in a row is one."""
    found: list[str] = []
    printed = ""
    for number, output in enumerate([*cell.get("outputs", []), None]):
        if output is not None and output["output_type"] == "stream":
            printed += "".join(output["text"])
            continue
        if printed:
            found.append(f'<pre class="gsnb-printed" tabindex="0">{escape(printed.rstrip(), quote=False)}</pre>')
            printed = ""
        if output is not None:
            found.append(_shown(output, f"{cell['id']}-{number}", page, places, files))
    return [html for html in found if html]


def _shown(output: Mapping[str, Any], name: str, page: str, places: Places, files: Files) -> str:
    data, metadata = output.get("data", {}), output.get("metadata", {})
    if "text/html" in data:
        return f'<div class="gsnb-html">{source_links("".join(data["text/html"]), page, places)}</div>'
    for kind, suffix in _PICTURES.items():
        if kind in data:
            content = base64.b64decode("".join(data[kind]))
            words = metadata.get(kind, {})
            return picture_html(files.add(f"{name}.{suffix}", content), content, words, suffix)
    text = "".join(data.get("text/plain", output.get("traceback", "")))
    return f'<pre class="gsnb-printed" tabindex="0">{escape(text, quote=False)}</pre>' if text else ""


def source_links(html: str, page: str, places: Places) -> str:
    """Links of a notebook to lines of files as links to the pages of these files; JupyterLab counts lines from 0."""
    return _SOURCE.sub(
        lambda m: f'href="{places.source_url(m[1], seen_from=page, line=int(m[2]) + 1)}"'
        if places.is_shown(m[1]) else m[0],
        html,
    )  # fmt: skip


def picture_html(address: str, content: bytes, metadata: Mapping[str, Any], suffix: str) -> str:
    """An image with its size, so that the page does not move when it is loaded."""
    width, height = _size(content)
    wide = int(metadata.get("width", width))
    drawing = ' class="gsnb-figure"' if suffix == "png" else ""
    return (
        f'<img{drawing} src="{address}" width="{wide}" height="{round(wide * height / width)}" loading="lazy" '
        f'alt="{escape(str(metadata.get("alt", "")) or "picture")}">'
    )


def _size(content: bytes) -> Sequence[int]:
    import io

    from PIL import Image

    return Image.open(io.BytesIO(content)).size
