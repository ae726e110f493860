"""Pictures and widgets in a notebook's output: what every panel and viewer uses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import anywidget
import cv2
import traitlets as t

from ..drawing.curves import curve_figure as curve_figure
from ..drawing.curves import figure_png as figure_png
from ..drawing.curves import figure_words
from ..drawing.encoding import encode_jpeg, encode_png
from ..drawing.pictures import AnyImage
from ..drawing.pictures import colour_depth as colour_depth
from ..drawing.pictures import error_map as error_map
from ..drawing.pictures import paint_cells as paint_cells
from ..drawing.pictures import side_by_side as side_by_side
from ..drawing.pictures import to_uint8 as to_uint8
from ..drawing.stored import WIDGET_MIME as WIDGET_MIME
from ..drawing.stored import Bundle as Bundle
from ..drawing.stored import LiveOutput as LiveOutput
from ..drawing.stored import static_views as static_views
from ..drawing.stored import with_stored as with_stored
from ..viewer.front_end import join_modules, source

if TYPE_CHECKING:
    from IPython.display import Image
    from matplotlib.figure import Figure


ROOM = "viz"
"""Where the JavaScript of notebooks is; that of the splat viewer is in the room ``viewer``."""


def show(
    images: AnyImage | Sequence[AnyImage],
    labels: str | Sequence[str] = (),
    *,
    scale: float | int = 1.0,
    alt: str = "",
) -> "Image":
    """One image, or several in a row with a label above each, as the output of a notebook cell.

    Args:
        images: RGB, 0..1 or bytes. [H, W, 3]
        labels: One per image, or none.
        scale: Size on screen, screen pixels per image pixel.
        alt: What it shows, for screen readers and for pages made from the notebook; by default the
            labels.
    """
    from IPython.display import Image

    row: list[Any] = list(images) if isinstance(images, (list, tuple)) else [images]
    captions = [labels] if isinstance(labels, str) else list(labels)
    # resized before the labels are written, so that the text keeps its size
    if scale < 1 or captions:
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        row = [cv2.resize(to_uint8(i), None, fx=scale, fy=scale, interpolation=how) for i in row]
        scale = 1
    picture = side_by_side(row, captions) if captions or len(row) > 1 else to_uint8(row[0])
    words = alt or "; ".join(captions) or "picture"
    return Image(
        data=encode_jpeg(picture),
        format="jpeg",
        width=round(picture.shape[1] * scale),
        alt=words,
    )


def show_figure(figure: "Figure", *, width: int = 520, alt: str = "") -> "Image":
    """A graph as the output of a notebook cell, readable on a light and on a dark page.

    Args:
        figure: A matplotlib figure; its ground becomes transparent.
        width: On screen, pixels.
        alt: What it shows, for screen readers and for pages made from the notebook; by default the
            names of its axes and curves.
    """
    from IPython.display import Image

    return Image(
        data=figure_png(figure), format="png", width=width, alt=alt or figure_words(figure)
    )


def with_picture(
    bundle: Any,
    picture: AnyImage,
    text: str,
    *,
    alt: str = "",
) -> Bundle:
    """A widget's mime bundle with a picture beside it, for readers of the stored notebook; and its
    metadata.

    With ``static_views()`` only the picture is kept.

    Args:
        bundle: The widget's own.
        picture: What it shows now.
        text: For readers without pictures.
        alt: The picture's description for screen readers; by default ``text``.
    """
    kinds = {"image/png": encode_png(picture), "image/jpeg": encode_jpeg(picture)}
    kind = min(kinds, key=lambda name: len(kinds[name]))  # PNG for graphs, JPEG for photographs
    return with_stored(bundle, kind, kinds[kind], text, {"alt": alt or text})


_LOST_CSS = """
.gsnb-lost:empty { display: none; }
.gsnb-lost { margin: 6px 0; padding: 4px 8px; border-left: 3px solid #d1495b; }
"""


class LostNotice(anywidget.AnyWidget):
    """Empty while the kernel lives; after a restart or a shutdown it tells to run the cell again.

    It also gives the sliders beside it their labels as names for screen readers, which ipywidgets
    does not.
    """

    _esm = join_modules((("viewer", "lost"), (ROOM, "notice")))
    _css = _LOST_CSS


def synced(trait: t.TraitType) -> Any:
    """A trait that Python and the page share."""
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

    @property
    def moved(self) -> tuple[float | int, float | int]:
        """(du, dv) since the start, pixels of the image."""
        return self.now[0] - self.start[0], self.now[1] - self.start[1]


class ClickImage(anywidget.AnyWidget):
    """A picture that says where it is touched, with the mouse, a finger, or the arrow keys.

    With touch "stroke", ``on_stroke(f)`` calls ``f(stroke)`` while the picture is dragged; each
    arrow key drags by 4 pixels. While ``f`` is at work, newer positions replace each other, so that
    only the last one waits.

    Args:
        width: On screen, pixels; less where the page is narrower.
        format: "jpeg" for photographs, "png" for drawings.
        alt: What it shows, for screen readers.
        touch: "stroke", or "" for a picture that is only looked at.
    """

    _esm = source(ROOM, "click_image.js")
    _css = source(ROOM, "click_image.css")

    value = synced(t.Bytes(b""))
    format = synced(t.Enum(("jpeg", "png"), "jpeg"))
    size = synced(
        t.Tuple(
            t.Int(),
            t.Int(),
            default_value=(1, 1),
        )
    )
    width = synced(t.Int(320))
    alt = synced(t.Unicode("picture"))
    touch = synced(t.Enum(("", "stroke"), ""))
    stroke = synced(
        t.List(
            t.Float(),
            [0.0] * 5,
            minlen=5,
            maxlen=5,
        )
    )

    def show(self, picture: AnyImage) -> None:
        """Show another picture."""
        height, width = picture.shape[:2]
        self.size = (width, height)
        self.value = encode_jpeg(picture, 92) if self.format == "jpeg" else encode_png(picture, 3)

    def on_stroke(self, act: Callable[[Stroke], None]) -> None:
        """Call ``act`` with the newest state of each drag."""

        def on_change(_change: Any) -> None:
            number, u0, v0, u, v = self.stroke
            act(
                Stroke(
                    number=int(number),
                    start=(u0, v0),
                    now=(u, v),
                )
            )

        self.observe(on_change, "stroke")
