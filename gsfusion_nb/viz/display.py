"""Putting arrays and live views into a notebook's output."""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..drawing.curves import curve_figure as curve_figure
from ..drawing.curves import figure_png as figure_png
from ..drawing.curves import figure_words
from ..drawing.pictures import AnyImage, encode_jpeg
from ..drawing.pictures import colour_depth as colour_depth
from ..drawing.pictures import error_map as error_map
from ..drawing.pictures import paint_cells as paint_cells
from ..drawing.pictures import side_by_side as side_by_side
from ..drawing.pictures import to_uint8 as to_uint8

if TYPE_CHECKING:
    from IPython.display import Image
    from matplotlib.figure import Figure

Bundle = tuple[dict[str, Any], dict[str, Any]]
"""What a notebook stores of an output, by MIME type, and words about it."""
WIDGET_MIME = "application/vnd.jupyter.widget-view+json"


def static_views() -> bool:
    """Whether live views should leave only a picture in the notebook.

    True with ``GSNB_VIEW=static`` (the notebook is executed to be stored: a widget without its kernel shows
    nothing) and with ``GSNB_SMOKE=1`` (a quick test run).
    """
    return os.environ.get("GSNB_VIEW") == "static" or os.environ.get("GSNB_SMOKE", "0") not in ("", "0")


def show(
    images: AnyImage | Sequence[AnyImage], labels: str | Sequence[str] = (), *, scale: float | int = 1.0, alt: str = ""
) -> "Image":
    """One image, or several in a row with a label above each, as the output of a notebook cell.

    Args:
        images: RGB, 0..1 or bytes. [H, W, 3]
        labels: One per image, or none.
        scale: Size on screen, screen pixels per image pixel.
        alt: What it shows, for screen readers and for pages made from the notebook; by default the labels.
    """
    import cv2
    from IPython.display import Image

    row: list[Any] = list(images) if isinstance(images, (list, tuple)) else [images]
    captions = [labels] if isinstance(labels, str) else list(labels)
    if scale < 1 or captions:  # resized before the labels are written, so that the text keeps its size
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        row = [cv2.resize(to_uint8(i), None, fx=scale, fy=scale, interpolation=how) for i in row]
        scale = 1
    picture = side_by_side(row, captions) if captions or len(row) > 1 else to_uint8(row[0])
    words = alt or "; ".join(captions) or "picture"
    return Image(data=encode_jpeg(picture), format="jpeg", width=round(picture.shape[1] * scale), alt=words)


def show_figure(figure: "Figure", *, width: int = 520, alt: str = "") -> "Image":
    """A graph as the output of a notebook cell, readable on a light and on a dark page.

    Args:
        figure: A matplotlib figure; its ground becomes transparent.
        width: On screen, pixels.
        alt: What it shows, for screen readers and for pages made from the notebook; by default the names of its axes
            and curves.
    """
    from IPython.display import Image

    return Image(data=figure_png(figure), format="png", width=width, alt=alt or figure_words(figure))


def with_picture(bundle: Any, picture: AnyImage, text: str, *, alt: str = "") -> Bundle:
    """A widget's mime bundle with a picture beside it, for readers of the stored notebook; and its metadata.

    A live notebook shows the widget, a code host the picture. With ``static_views()`` only the picture is kept.

    Args:
        bundle: The widget's own.
        picture: What it shows now.
        text: For readers without pictures.
        alt: The picture's description for screen readers; by default ``text``.
    """
    import base64

    data = dict(bundle) if isinstance(bundle, dict) else {}
    if static_views():
        data.pop(WIDGET_MIME, None)
    data["image/jpeg"] = base64.b64encode(encode_jpeg(picture)).decode("ascii")
    data["text/plain"] = text
    return data, {"image/jpeg": {"alt": alt or text}}
