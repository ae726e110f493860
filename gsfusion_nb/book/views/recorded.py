"""A recorded view: what its script in the page needs, and the pictures beside it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np

WIDEST_PX = 760
"""Pictures are made narrower than this."""


@dataclass(kw_only=True, eq=False)
class Recorded:
    """One view of a chapter."""

    kind: str
    """Which script shows it: "panel", "stepper", "splat", "mesh", "pixels" or "trace"."""
    data: dict[str, Any]
    """What the script needs, as JSON."""
    words: str
    """What the reader can do with it, a sentence."""
    pictures: dict[str, bytes] = field(default_factory=dict)
    """Files beside the script, by name."""

    def script(self, name: str) -> bytes:
        """A file that gives the data to the page; a script, because a page opened from a folder may not fetch JSON."""
        return f"gsnbView({json.dumps(name)}, {json.dumps(self.data, ensure_ascii=False)});\n".encode()

    @property
    def size(self) -> int:
        """Bytes of the script."""
        return len(self.script(""))


def placeholder(recorded: Mapping[str, Any], folder: str, cell: str) -> str:
    """HTML of a view before its script runs; the stored picture takes the place of the remark."""
    address = escape(f"{folder}/{cell}.view.js")
    return (
        f'<div class="gsnb-view" data-kind="{recorded["kind"]}" data-name="{escape(cell)}" data-src="{address}" '
        f'data-files="{escape(folder)}/{escape(cell)}/" data-bytes="{recorded["bytes"]}">'
        f'<p class="gsnb-view-words"><b>Live.</b> {escape(recorded["words"])}</p>'
        f'<div class="gsnb-view-stage"><!-- picture --></div></div>'
    )


def needs_kernel(words: str) -> str:
    """HTML of a view that is not recorded: why it shows only a picture."""
    return f'<p class="gsnb-view-words"><b>Needs a kernel.</b> {escape(words)}</p><!-- picture -->'


def webp(picture: np.ndarray, quality: int = 72) -> bytes:
    """A picture as WebP, made narrower if it is too wide. [H, W, 3 or 4] bytes, red first"""
    import cv2

    height, width = picture.shape[:2]
    if width > WIDEST_PX:
        size = (WIDEST_PX, round(height * WIDEST_PX / width))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    code = cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    return cv2.imencode(".webp", cv2.cvtColor(picture, code), [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
