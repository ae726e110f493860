"""Camera intrinsics from numbers, matrices and JSON files."""

import math
from pathlib import Path
from typing import Any

from ...data.lens.camera_model import CameraModel
from ...data.recorded.camera_json import number, numbers
from ...data.sequence import SequenceError
from ...errors import shown
from ...foreign import read_object
from ...types import Camera
from .trajectory import read_numbers

_WAYS = "'fx fy cx cy [k1 k2 p1 p2 [k3 ...]]', a 3x3 or 4x4 matrix, or JSON (Open3D's, or fx fy cx cy)"


def read_intrinsics(text_or_file: str, size: tuple[int, int], *, centre: float = 0.0) -> CameraModel:
    """Camera of an option: numbers, or a file of numbers or JSON.

    Args:
        text_or_file: "fx fy cx cy [k1 k2 p1 p2 [k3 ...]]", or a file with these numbers, a matrix, or a JSON object.
        size: Width and height of the colour images, pixels; a JSON object with a size of its own overrides it.
        centre: Where the intrinsics put the centre of the first pixel, 0 or 0.5; JSON may say ``pixel_centre``.

    Raises:
        SequenceError: none of these, or a focal length that is not positive.
    """
    path = Path(text_or_file)
    if path.suffix.lower() == ".json":
        return intrinsics_of_json(path, size, centre=centre)
    try:
        values = [float(w) for w in text_or_file.replace(",", " ").split()]
        source = f"intrinsics {shown(text_or_file)}"
    except ValueError:
        values, source = read_numbers(path, _WAYS), str(path)
    if len(values) in (9, 16) and values[-1] == 1:
        return model_of_matrix(values, size, source, centre=centre)
    if len(values) not in (4, 8, 9, 12, 16, 18):
        raise SequenceError(f"{source} must be {_WAYS}, got {len(values)} numbers")
    return model_of(values[:4], size, source, centre=centre, distortion=tuple(values[4:]))


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
    if not all(math.isfinite(v) for v in (*values, *distortion)) or values[0] <= 0 or values[1] <= 0:
        raise SequenceError(
            f"{source}: the focal lengths must be > 0 and all intrinsics finite, got {values[0]:g} and {values[1]:g}"
        )
    fx, fy, cx, cy = values
    shift = 0.5 - centre
    try:
        camera = Camera(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx + shift, cy=cy + shift)
    except ValueError as e:
        raise SequenceError(f"{source}: {e}") from None
    return CameraModel(camera, distortion if any(distortion) or fisheye else (), fisheye)


def model_of_matrix(values: list[float], size: tuple[int, int], source: str, *, centre: float) -> CameraModel:
    """Camera of a row-major 3x3 or 4x4 matrix with fx, fy on the diagonal and cx, cy in the third column."""
    n = 3 if len(values) == 9 else 4
    if len(values) != n * n or abs(values[n * n - 1] - 1) > 1e-9:
        raise SequenceError(f"{source} must be a 3x3 or 4x4 matrix with fx 0 cx / 0 fy cy / 0 0 1, row by row")
    if abs(values[1]) > 1e-3 * abs(values[0]) or abs(values[2 * n]) > 1e-6 or abs(values[2 * n + 1]) > 1e-6:
        raise SequenceError(
            f"{source} must be a matrix with fx 0 cx / 0 fy cy / 0 0 1, row by row; this one looks transposed or skewed"
        )
    return model_of([values[0], values[n + 1], values[2], values[n + 2]], size, source, centre=centre)


def intrinsics_of_json(path: Path, size: tuple[int, int] | None, *, centre: float = 0.0) -> CameraModel:
    """Camera of Open3D's camera_intrinsic.json (column-major ``intrinsic_matrix``), or of keys fx, fy, cx, cy."""
    values = read_object(path, f"the camera's intrinsics as {_WAYS}")
    return model_of_object(values, size, str(path), centre=centre)


def model_of_object(values: dict[str, Any], size: tuple[int, int] | None, source: str, *, centre: float) -> CameraModel:
    """Camera of a JSON object (``intrinsics_of_json``)."""
    path = Path(source)
    if "width" in values or size is None:
        checked = numbers(values, ("width", "height"), path)
        size = (round(checked["width"]), round(checked["height"]))
    if "intrinsic_matrix" in values:
        matrix = values["intrinsic_matrix"]
        plain = isinstance(matrix, list) and all(type(v) in (int, float) for v in matrix)
        if not plain or len(matrix) != 9:
            raise SequenceError(f"{source}: intrinsic_matrix must hold 9 numbers, column by column")
        rows = [float(matrix[i]) for i in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
        return model_of_matrix(rows, size, f"{source}: intrinsic_matrix (column by column)", centre=centre)
    checked = numbers(values, ("fx", "fy", "cx", "cy"), path)
    distortion = tuple(number(values, k, 0.0, source) for k in ("k1", "k2", "p1", "p2", "k3"))
    centre = number(values, "pixel_centre", centre, source)
    return model_of([checked[k] for k in ("fx", "fy", "cx", "cy")], size, source, centre=centre, distortion=distortion)
