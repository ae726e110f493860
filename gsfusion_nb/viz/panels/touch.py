"""What a drag over a panel's picture takes hold of: a pixel, or a handle that is drawn on it."""

import math
from collections.abc import Mapping

import cv2

from ...drawing.pictures import LABEL_PX, Picture
from ...types import Camera
from ..display import Stroke
from .panel import Number, Slider


def pixel_sliders(
    camera: Camera,
    pixel: tuple[int, int] | None = None,
) -> dict[str, Slider]:
    """Sliders ``u`` and ``v`` for a pixel of a picture, which start in its middle by default."""
    u, v = pixel or (camera.width // 2, camera.height // 2)
    return {
        "u": Slider(
            value=u,
            low=0,
            high=camera.width - 1,
            step=1,
            label="pixel column u",
        ),
        "v": Slider(
            value=v,
            low=0,
            high=camera.height - 1,
            step=1,
            label="pixel row v",
        ),
    }


def touched_pixel(
    stroke: Stroke,
    camera: Camera,
    zoom: float = 1.0,
) -> dict[str, Number]:
    """Values of ``pixel_sliders`` under the pointer, for a labelled image that is ``zoom`` times as
    large.

    Empty if the drag began outside it.
    """
    (u0, v0), (u, v) = (((u / zoom), (v - LABEL_PX) / zoom) for u, v in (stroke.start, stroke.now))
    in_picture = 0 <= u0 < camera.width and 0 <= v0 < camera.height
    return {"u": math.floor(u), "v": math.floor(v)} if in_picture else {}


Point = tuple[float | int, float | int]
REACH_PX = 26.0
"""A drag that begins farther than this from all handles grabs none, pixels."""


def draw_handles(picture: Picture, handles: Mapping[str, Point]) -> Picture:
    """A copy of the picture with a ringed disc at each handle (u, v)."""
    image = picture.copy()
    for u, v in handles.values():
        at = (round(16 * min(max(u, -1e4), 1e4)), round(16 * min(max(v, -1e4), 1e4)))
        for radius, colour in ((7, (20, 20, 24)), (6, (255, 255, 255)), (4, (255, 140, 0))):
            cv2.circle(image, at, radius * 16, colour, -1, cv2.LINE_AA, 4)
    return image


def nearest_handle(handles: Mapping[str, Point], at: Point) -> str | None:
    """Name of the handle nearest to a point, ``None`` if all are farther than ``REACH_PX``; the
    first of equal ones."""
    distances = {
        name: ((u - at[0]) ** 2 + (v - at[1]) ** 2) ** 0.5 for name, (u, v) in handles.items()
    }
    name = min(distances, key=lambda k: distances[k], default=None)
    return name if name is not None and distances[name] <= REACH_PX else None
