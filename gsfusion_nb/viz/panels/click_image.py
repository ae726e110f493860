"""A picture in a notebook that can be clicked and dragged."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import anywidget
import traitlets as t

from ...drawing.pictures import AnyImage, encode_jpeg, encode_png

_STATIC = Path(__file__).parent / "static"


def _synced(trait: t.TraitType) -> Any:
    return trait.tag(sync=True)


@dataclass(frozen=True, kw_only=True)
class Stroke:
    """A drag over a picture, from where it began to where the pointer is now."""

    number: int
    """Increases with each drag."""
    start: tuple[float | int, float | int]
    """(u, v) where the button was pressed, pixels of the image."""
    now: tuple[float | int, float | int]
    """(u, v) of the pointer."""
    shift: bool = False
    """Whether the shift key was held at the start."""

    @property
    def moved(self) -> tuple[float | int, float | int]:
        """(du, dv) since the start, pixels of the image."""
        return self.now[0] - self.start[0], self.now[1] - self.start[1]


class ClickImage(anywidget.AnyWidget):
    """A picture that says where it is touched, with the mouse, a finger, or the arrow keys.

    With touch "pixel", ``pixel`` is the (column, row) last clicked, dragged to, or reached with the arrow keys;
    ``observe(f, "pixel")`` calls ``f`` at each change. With touch "stroke", ``on_stroke(f)`` calls ``f(stroke)`` while
    the picture is dragged; each arrow key drags by 4 pixels. While ``f`` is at work, newer positions replace each
    other, so that only the last one waits. The picture may be an enlarged copy of the image: positions are in pixels of
    the image.

    Args:
        columns, rows: Size of the image, pixels.
        width: On screen, pixels; less where the page is narrower.
        format: "jpeg" for photographs, "png" for drawings.
        alt: What it shows, for screen readers.
        touch: "pixel", "stroke", or "" for a picture that is only looked at.
    """

    _esm = (_STATIC / "click_image.js").read_text(encoding="utf-8")
    _css = (_STATIC / "click_image.css").read_text(encoding="utf-8")

    value = _synced(t.Bytes(b""))
    format = _synced(t.Enum(("jpeg", "png"), "jpeg"))
    size = _synced(t.Tuple(t.Int(), t.Int(), default_value=(1, 1)))
    width = _synced(t.Int(320))
    alt = _synced(t.Unicode(""))
    touch = _synced(t.Enum(("", "pixel", "stroke"), "pixel"))
    pixel = _synced(t.Tuple(t.Int(), t.Int(), default_value=(0, 0)))
    stroke = _synced(t.List(t.Float(), [0.0] * 6, minlen=6, maxlen=6))

    def __init__(
        self,
        columns: int,
        rows: int,
        *,
        width: int = 320,
        format: str = "jpeg",
        alt: str = "picture",
        touch: Literal["", "pixel", "stroke"] = "pixel",
    ):
        super().__init__(size=(columns, rows), width=width, format=format, alt=alt, touch=touch)

    def show(self, picture: AnyImage) -> None:
        """Show another picture."""
        self.value = encode_jpeg(picture, 92) if self.format == "jpeg" else encode_png(picture, 3)

    def on_stroke(self, act: Callable[[Stroke], None]) -> None:
        """Call ``act`` with the newest state of each drag."""
        self.observe(lambda _change: act(self.last_stroke), "stroke")

    @property
    def last_stroke(self) -> Stroke:
        """The newest drag."""
        number, shift, u0, v0, u, v = self.stroke
        return Stroke(number=int(number), start=(u0, v0), now=(u, v), shift=bool(shift))

    @t.validate("pixel")
    def _inside(self, proposal: Any) -> tuple[int, int]:
        u, v = proposal["value"]
        columns, rows = self.size
        return min(max(u, 0), columns - 1), min(max(v, 0), rows - 1)
