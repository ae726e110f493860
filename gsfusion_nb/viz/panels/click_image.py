"""A picture in a notebook that can be clicked."""

from pathlib import Path
from typing import Any

import anywidget
import traitlets as t

from ...drawing.pictures import AnyImage, encode_jpeg, encode_png

_SOURCE = Path(__file__).parent / "static" / "click_image.js"


def _synced(trait: t.TraitType) -> Any:
    return trait.tag(sync=True)


class ClickImage(anywidget.AnyWidget):
    """A picture; ``pixel`` is the (column, row) last clicked, dragged to, or reached with the arrow keys.

    ``observe(f, "pixel")`` calls ``f`` at each change. The picture may be an enlarged copy of the image: ``pixel`` is
    in pixels of the image.

    Args:
        columns, rows: Size of the image, pixels.
        width: On screen, pixels.
        format: "jpeg" for photographs, "png" for drawings.
        alt: What it shows, for screen readers.
    """

    _esm = _SOURCE.read_text(encoding="utf-8")

    value = _synced(t.Bytes(b""))
    format = _synced(t.Enum(("jpeg", "png"), "jpeg"))
    size = _synced(t.Tuple(t.Int(), t.Int(), default_value=(1, 1)))
    width = _synced(t.Int(320))
    pixel = _synced(t.Tuple(t.Int(), t.Int(), default_value=(0, 0)))
    alt = _synced(t.Unicode(""))

    def __init__(self, columns: int, rows: int, *, width: int = 320, format: str = "jpeg", alt: str = "picture"):
        super().__init__(size=(columns, rows), width=width, format=format, alt=alt)

    def show(self, picture: AnyImage) -> None:
        """Show another picture."""
        self.value = encode_jpeg(picture, 92) if self.format == "jpeg" else encode_png(picture, 3)

    @t.validate("pixel")
    def _inside(self, proposal: Any) -> tuple[int, int]:
        u, v = proposal["value"]
        columns, rows = self.size
        return min(max(u, 0), columns - 1), min(max(v, 0), rows - 1)
