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
