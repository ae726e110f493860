"""The lens among the names and values of a camera: which one it is, and its distortion.

A name that looks like a part of the lens and is not known is refused, because leaving it out would
change the camera.
"""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...checks import shown
from ...errors import SequenceError
from ...files import parsing
from .calibration_tree import Tree
from .image_changes import is_not_zero

_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

_FISHEYE_COEFFICIENTS = ("k1", "k2", "k3", "k4")

_LISTS = (
    "distortion_coefficients",
    "distortion_coeffs",
    "distCoeffs",
    "dist_coeffs",
    "distortion",
    "distortionCoeff",
    "coeffs",
    "distortion_parameters",
    "D",
)
"""The last but one is a group of VINS-Fusion, beside that of the focal lengths."""

_LENSES = (
    "distortion_model",
    "distortion_type",
    "type",
    "model",
    "model_type",
    "camera_model",
    "camera_type",
    "lens_model",
    "lens_type",
)

_BROWN = (
    "",
    "brown_conrady",
    "none",
    "opencv",
    "perspective",
    "pinhole",
    "plumb_bob",
    "radial-tangential",
    "radtan",
    "rational_polynomial",
    "simple_pinhole",
)

_FISHEYE = ("equidistant", "equi", "fisheye", "kannalabrandt8", "kannala_brandt4", "opencv_fisheye")

OF_A_LENS = re.compile(
    r"(?i)k_?\d+|p_?\d+|xi|alpha|beta|skew|s|(lens_?|cam(era)?_?)?(radial|tangential|distort)\w*"
    r"|dist(_?(coef|param)\w*)?|is_fisheye|fisheye"
)
"""Names of what changes a camera."""

_REALSENSE = (
    "none",
    "modified_brown_conrady",
    "inverse_brown_conrady",
    "ftheta",
    "brown_conrady",
    "kannala_brandt4",
)
"""Lenses of librealsense, by their number."""


def list_of(value: Any) -> list[float]:
    """Numbers of a list, of rows, or of OpenCV's and ROS's matrices, which have ``data``."""
    if isinstance(value, Mapping):
        value = value["data"]
    return np.ravel(np.array(value, dtype=float)).tolist()


def is_fisheye_lens(values: Tree, source: str) -> bool:
    """Whether the lens is a fisheye. Raises ``SequenceError`` for one that OpenCV's two models are
    not."""
    if values.get("is_fisheye") or values.get("fisheye"):
        return True
    names = _lens_names(values)
    if any(name in _FISHEYE for name in names):
        return True
    unknown = [name for name in names if name not in _BROWN]
    coefficients = [values.get(name, 0.0) for name in _COEFFICIENTS]
    listed = _listed_coefficients(values, _COEFFICIENTS, source) if unknown else []
    if unknown and (any(listed) or any(map(is_not_zero, coefficients))):
        raise SequenceError(
            f"{source}: the lens {shown(unknown[0])} with other coefficients than 0 cannot be "
            f"undistorted; known: {', '.join(name for name in (*_BROWN, *_FISHEYE) if name)}"
        )
    return False


def _lens_names(values: Tree) -> list[str]:
    """What the lens is called: also by a name where others have its coefficients."""
    named = [values[name] for name in _LENSES if isinstance(values.get(name), str | int)]
    instead = [values[name] for name in _LISTS if isinstance(values.get(name), str)]
    return [
        *map(_lens_name, named),
        *(_lens_name(value) for value in instead if _is_lens_name(value)),
    ]


def _is_lens_name(value: Any) -> bool:
    """Whether ``value`` stands for a lens; nothing stands for one without distortion."""
    return value is None or (isinstance(value, str) and _lens_name(value) in (*_BROWN, *_FISHEYE))


def _lens_name(value: str | int) -> str:
    """The name of a lens in small letters: "distortion.brown_conrady" and librealsense's 4 are
    one."""
    if isinstance(value, int):
        return _REALSENSE[value] if 0 <= value < len(_REALSENSE) else f"number {value}"
    return value.lower().rsplit(".", 1)[-1]


def coefficients_of(
    values: Tree,
    source: str,
    *,
    fisheye: bool,
) -> tuple[float, ...]:
    """The distortion in OpenCV's order; () where there is none."""
    names = _FISHEYE_COEFFICIENTS if fisheye else _COEFFICIENTS
    for name, value in values.items():
        is_known = name in names or name in _LISTS or name in ("is_fisheye", "fisheye", *_LENSES)
        if OF_A_LENS.fullmatch(str(name)) and not is_known and is_not_zero(value):
            raise SequenceError(
                f"{source}: {name} = {shown(value)} changes the camera in a way that is not known "
                f"here; undistort the images first; known: {', '.join(names)}"
            )
    needs_model = is_not_zero(values.get("k4", 0)) and not {"p1", "p2"} & values.keys()
    if needs_model and not fisheye and not _lens_names(values):
        raise SequenceError(
            f"{source} has k1 to k4 without p1 and p2, as a fisheye has, but does not name the "
            "lens; expected a model, such as fisheye or rational_polynomial"
        )
    coefficient_list = _listed_coefficients(values, names, source)
    coefficients = [float(values.get(name, 0.0)) for name in names]
    if any(coefficient_list):
        if fisheye and len(coefficient_list) != len(_FISHEYE_COEFFICIENTS):
            raise SequenceError(
                f"{source}: a fisheye must have the coefficients k1 k2 k3 k4, got "
                f"{len(coefficient_list)}"
            )
        return tuple(coefficient_list)
    return _used(coefficients) if any(coefficients) or fisheye else ()


def _used(coefficients: list[float]) -> tuple[float, ...]:
    """Without the last ones that are 0; OpenCV takes five at least."""
    n = max((i for i, value in enumerate(coefficients, 1) if value), default=0)
    return tuple(coefficients[: max(n, 5)])


def _listed_coefficients(values: Tree, names: tuple[str, ...], source: str) -> list[float]:
    """The distortion of a list, or of a group that names its coefficients; empty where there is
    neither, or only the name of the lens.

    Args:
        values: Of the camera.
        names: Coefficients that a group may have, in OpenCV's order.
        source: The file, for messages.

    Raises:
        SequenceError: the group has other names, or the text is neither numbers nor a lens.
    """
    name = next((name for name in _LISTS if not _is_lens_name(values.get(name, ""))), None)
    if name is None:
        return []
    value = values[name]
    if isinstance(value, str):
        with parsing(source, f"numbers of {name}"):
            return [float(word) for word in value.strip("[]() ").replace(",", " ").split()]
    if isinstance(value, Mapping) and "data" not in value:
        unknown = [key for key, part in value.items() if key not in names and is_not_zero(part)]
        if unknown:
            raise SequenceError(
                f"{source}: {name} has {shown(', '.join(map(str, unknown)))}; expected "
                f"{', '.join(names)}"
            )
        return list(_used([float(value.get(coefficient, 0.0)) for coefficient in names]))
    return list_of(value)
