"""Camera intrinsics from numbers, matrices and JSON."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from ...checks import shown
from ...data.lens import CameraModel
from ...data.sequence import SequenceError
from ...files import parsing, read_object, read_text, refusing
from ...types import Camera
from .recording import read_array
from .trajectory import read_numbers

_PINHOLE = ("fx", "fy", "cx", "cy")
_WAYS = (
    "'fx fy cx cy [k1 k2 p1 p2 [k3 ...]]', the focal length alone, a 3x3 or 4x4 matrix, lines such as 'fx: 525', or "
    "JSON (Open3D's, or fx fy cx cy)"
)


def read_intrinsics(text_or_file: str, size: tuple[int, int], *, centre: float = 0.0) -> CameraModel:
    """Camera of an option: numbers, or a file of numbers or JSON.

    Args:
        text_or_file: "fx fy cx cy [k1 k2 p1 p2 [k3 ...]]", the focal length alone, or a file with these numbers, a
            matrix as text or NumPy, lines such as "Camera.fx: 525", or a JSON object.
        size: Width and height of the colour images, pixels; a JSON object with a size of its own overrides it.
        centre: Where the intrinsics put the centre of the first pixel, 0 or 0.5; JSON may say ``pixel_centre``.

    Raises:
        SequenceError: none of these, or a focal length that is not positive.
    """
    path = Path(text_or_file)
    if path.suffix.lower() == ".json":
        return model_of_object(read_object(path, f"the camera's intrinsics as {_WAYS}"), size, str(path), centre=centre)
    try:
        values = [float(w) for w in text_or_file.replace(",", " ").split()]
        source = f"intrinsics {shown(text_or_file)}"
    except ValueError:
        values, source = _numbers_in(path), str(path)
    if len(values) == 1:
        values = [values[0], values[0], size[0] / 2 - 0.5 + centre, size[1] / 2 - 0.5 + centre]
    if len(values) in (9, 16) and values[-1] == 1:
        return model_of_matrix(values, size, source, centre=centre)
    if len(values) not in (4, 8, 9, 12, 16, 18):
        raise SequenceError(f"{source} must be {_WAYS}, got {len(values)} numbers")
    return model_of(values[:4], size, source, centre=centre, distortion=tuple(values[4:]))


def _numbers_in(path: Path) -> list[float]:
    """Numbers of a file: a NumPy array, lines that name fx, fy, cx and cy, or nothing but numbers."""
    if path.suffix == ".npy":
        return read_array(path, _WAYS).ravel().tolist()
    named = dict(re.findall(r"\b(fx|fy|cx|cy)\b\W*?(-?[\d.]+)", read_text(path, _WAYS)))
    return [float(named[k]) for k in _PINHOLE] if len(named) == 4 else read_numbers(path, _WAYS)


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
    with refusing(f"{source}: "):
        camera = Camera(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx + shift, cy=cy + shift)
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


def model_of_object(values: dict[str, Any], size: tuple[int, int] | None, source: str, *, centre: float) -> CameraModel:
    """Camera of Open3D's camera_intrinsic.json (column-major ``intrinsic_matrix``), or of keys fx, fy, cx, cy."""
    with parsing(source, "intrinsic_matrix of 9 numbers, column by column, K, row by row, or fx, fy, cx, cy"):
        values = values.get("camera", values)
        if "width" in values or size is None:
            size = (round(values["width"]), round(values["height"]))
        if "K" in values:
            return model_of_matrix(np.ravel(values["K"]).astype(float).tolist(), size, f"{source}: K", centre=centre)
        if "intrinsic_matrix" in values:
            rows = [float(values["intrinsic_matrix"][i]) for i in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
            return model_of_matrix(rows, size, f"{source}: intrinsic_matrix (column by column)", centre=centre)
        pinhole = [float(values[k]) for k in _PINHOLE]
        distortion = tuple(float(values.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2", "k3"))
        centre = float(values.get("pixel_centre", centre))
    return model_of(pinhole, size, source, centre=centre, distortion=distortion)
