"""Handles in a picture: small discs that can be dragged."""

from collections.abc import Mapping

from ...drawing.pictures import Picture

Point = tuple[float | int, float | int]
REACH_PX = 26.0
"""A drag that begins farther than this from all handles grabs none, pixels."""


def draw_handles(picture: Picture, handles: Mapping[str, Point], ink: tuple[int, int, int] = (255, 140, 0)) -> Picture:
    """A copy of the picture with a ringed disc at each handle (u, v)."""
    import cv2

    image = picture.copy()
    for u, v in handles.values():
        at = (round(16 * min(max(u, -1e4), 1e4)), round(16 * min(max(v, -1e4), 1e4)))
        for radius, colour in ((7, (20, 20, 24)), (6, (255, 255, 255)), (4, ink)):
            cv2.circle(image, at, radius * 16, colour, -1, cv2.LINE_AA, 4)
    return image


def nearest_handle(handles: Mapping[str, Point], at: Point, reach_px: float = REACH_PX) -> str | None:
    """Name of the handle nearest to a point, ``None`` if all are farther than ``reach_px``; the first of equal ones."""
    apart = {name: ((u - at[0]) ** 2 + (v - at[1]) ** 2) ** 0.5 for name, (u, v) in handles.items()}
    name = min(apart, key=lambda k: apart[k], default=None)
    return name if name is not None and apart[name] <= reach_px else None


def draw_cross(picture: Picture, at: Point, ink: tuple[int, int, int] = (255, 210, 0)) -> Picture:
    """A copy of the picture with a small cross around a point (u, v), pixels, open in the middle."""
    import cv2

    image, (x, y) = picture.copy(), (round(at[0] - 0.5), round(at[1] - 0.5))
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inner, outer = ((x + r * dx, y + r * dy) for r in (4, 11))
        cv2.line(image, inner, outer, (0, 0, 0), 3)
        cv2.line(image, inner, outer, ink, 1)
    return image
