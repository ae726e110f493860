"""A camera of numbers: focal lengths and principal point, or a matrix."""

import math

from ...data.lens import CameraModel
from ...errors import SequenceError, refusing
from ...types import Camera


def model_of(
    values: list[float],
    size: tuple[int, int],
    source: str,
    *,
    centre: float,
    distortion: tuple[float, ...] = (),
    fisheye: bool = False,
) -> CameraModel:
    """Camera of fx, fy, cx, cy and its distortion in OpenCV's order."""
    if (
        not all(math.isfinite(v) for v in (*values, *distortion))
        or values[0] <= 0
        or values[1] <= 0
    ):
        raise SequenceError(
            f"{source}: the focal lengths must be > 0 and all intrinsics finite, got {values[0]:g} "
            f"and {values[1]:g}"
        )
    fx, fy, cx, cy = values
    shift = 0.5 - centre
    with refusing(f"{source}: "):
        camera = Camera(
            width=size[0],
            height=size[1],
            fx=fx,
            fy=fy,
            cx=cx + shift,
            cy=cy + shift,
        )
    return CameraModel(camera, distortion if any(distortion) or fisheye else (), fisheye)


def model_of_matrix(
    values: list[float],
    size: tuple[int, int],
    source: str,
    *,
    centre: float,
    distortion: tuple[float, ...] = (),
    fisheye: bool = False,
) -> CameraModel:
    """Camera of a row-major 3x3 or 4x4 matrix with fx, fy on the diagonal and cx, cy in the third
    column."""
    n = 3 if len(values) == 9 else 4
    if len(values) != n * n or abs(values[n * n - 1] - 1) > 1e-9:
        raise SequenceError(
            f"{source} must be a 3x3 or 4x4 matrix with fx 0 cx / 0 fy cy / 0 0 1, row by row"
        )
    if (
        abs(values[1]) > 1e-3 * abs(values[0])
        or abs(values[2 * n]) > 1e-6
        or abs(values[2 * n + 1]) > 1e-6
    ):
        raise SequenceError(
            f"{source} must be a matrix with fx 0 cx / 0 fy cy / 0 0 1, row by row; this one looks "
            "transposed or skewed"
        )
    pinhole = [values[0], values[n + 1], values[2], values[n + 2]]
    return model_of(pinhole, size, source, centre=centre, distortion=distortion, fisheye=fisheye)


_FAR_FROM_MIDDLE = 0.2
"""Of the width or height; those of cameras are within a tenth."""
_NOT_SQUARE = 0.1
_USUAL_FOCAL = (0.3, 3.0)
"""Focal lengths in widths of the image: 118 to 19 degrees."""


def doubt_of(camera: Camera) -> str:
    """Why intrinsics may be those of other images, or in another order; empty where they are as
    those of most cameras."""
    size = f"{camera.width}x{camera.height}"
    off = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    focal = camera.fx / camera.width
    reasons = []
    if off > _FAR_FROM_MIDDLE:
        reasons.append(
            f"the principal point {camera.cx:g}, {camera.cy:g} is far from the middle of images of "
            f"{size}"
        )
    if abs(camera.fx / camera.fy - 1) > _NOT_SQUARE:
        reasons.append(f"fx {camera.fx:g} and fy {camera.fy:g} differ")
    if not _USUAL_FOCAL[0] <= focal <= _USUAL_FOCAL[1]:
        reasons.append(f"fx {camera.fx:g} is unusual for a width of {camera.width}")
    if not reasons:
        return ""
    return (
        f"doubtful intrinsics: {', and '.join(reasons)}; they may be those of images of another "
        "size, or in another order (--intrinsics)"
    )
