"""The camera in a tree of names and values (``calibration_tree``), as other programs write it.

A name that looks like a part of the lens and is not known is refused, because leaving it out would
change the camera.
"""

import re
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from ...checks import shown
from ...data.lens import CameraModel
from ...errors import SequenceError
from ...files import parsing
from .calibration_tree import WAYS, Tree
from .camera_numbers import model_of, model_of_matrix
from .image_changes import check_unchanged, check_whole_sensor, is_not_zero

_PINHOLES = (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"), ("fl_x", "fl_y", "cx", "cy"))

_MATRICES = ("K", "camera_matrix", "cameraMatrix", "m_calibrationColorIntrinsic", "intrinsicMatrix")
"""The last two are BundleFusion's and ScanNet's, and DepthAI's."""

_OPEN3D = "intrinsic_matrix"
"""The matrix of Open3D, column by column."""

_FOUR = "intrinsics"
"""Kalibr's fx, fy, cx, cy."""

_SIZES = (
    ("width", "height"),
    ("image_width", "image_height"),
    ("w", "h"),
    ("W", "H"),
    ("m_colorWidth", "m_colorHeight"),
)

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

_OF_A_LENS = re.compile(
    r"k\d+|p\d+|xi|alpha|beta|skew|s|radial\w*|tangential\w*|distort\w*|is_fisheye|fisheye"
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

_SAYS_COLOUR = re.compile(r"(?i)rgb|colou?r")


def model_of_tree(
    tree: Tree, size: tuple[int, int] | None, source: str, *, centre: float
) -> CameraModel:
    """The camera among names and values, which may be in groups.

    Args:
        tree: Of a file.
        size: Width and height of the images, where the tree has none; None: it must have them.
        source: The file, for messages.
        centre: Where it puts the centre of the first pixel, 0 or 0.5, unless it says
            ``pixel_centre`` itself.

    Raises:
        SequenceError: no camera, several of which none is said to be colour, or a part of a lens
            that is not known.
    """
    if "CalibrationInformation" in tree:
        raise SequenceError(
            f"{source} is the raw calibration of an Azure Kinect, which holds for its whole "
            "sensors, not for images; Open3D's azure_kinect_mkv_reader writes intrinsic.json, "
            "which is read; or give 'fx fy cx cy'"
        )
    if "cameraData" in tree:
        tree = _cameras_of_depthai(tree)
    trees = dict(_cameras(tree, ""))
    trees = _left_of_zed(trees, size) or trees
    if len(trees) > 1:
        colour = [name for name in trees if _SAYS_COLOUR.search(name)]
        trees = {name: trees[name] for name in colour} if len(colour) == 1 else trees
    if not trees:
        names = ", ".join(map(str, tree)) or "nothing"
        raise SequenceError(
            f"{source} holds no camera in a way that is known, but {shown(names)}; known: {WAYS}"
        )
    if len(trees) > 1:
        raise SequenceError(
            f"{source} holds {len(trees)} cameras, {', '.join(trees)}; give that of the colour "
            "images as --intrinsics 'fx fy cx cy [k1 k2 p1 p2 k3]'"
        )
    ((_, values),) = trees.items()
    with parsing(source, f"a camera's intrinsics as {WAYS}"):
        return _model_of_values(values, size, source, centre)


def _cameras(
    tree: Tree, path: str, outer: Tree = MappingProxyType({})
) -> Iterator[tuple[str, Tree]]:
    """Path and values of each group that holds a camera, with the single values of the groups
    around it.

    ORB-SLAM3 has the focal lengths in Camera1 and the size of the images in Camera.
    """
    four = tree.get(_FOUR)
    is_kalibr = isinstance(four, list | tuple) and len(four) == 4
    has_matrix = any(name in tree for name in (*_MATRICES, _OPEN3D))
    if is_kalibr or has_matrix or any(set(names) <= tree.keys() for names in _PINHOLES):
        yield path or "the camera", {**outer, **tree}
        return
    common = tree.get("Camera")
    single = {**outer, **_single_values(tree), **_lens_groups(tree)}
    if isinstance(common, Mapping):
        single |= _single_values(common)
    for name, values in tree.items():
        if isinstance(values, Mapping):
            yield from _cameras(values, f"{path}.{name}" if path else str(name), single)


def _cameras_of_depthai(tree: Tree) -> Tree:
    """Cameras of OAK's calibration, a list of pairs of a socket and its camera; socket 0 is
    colour."""
    with parsing("cameraData", "pairs of a socket and a camera"):
        return {
            f"colour socket {n}" if n == 0 else f"socket {n}": camera
            for n, camera in tree["cameraData"]
        }


_WIDTHS_OF_ZED = {"2K": 2208, "FHD": 1920, "HD": 1280, "VGA": 672}


def _left_of_zed(
    trees: Mapping[str, Tree],
    size: tuple[int, int] | None,
) -> dict[str, Tree]:
    """Of the cameras of a ZED's calibration the left one for images of this width; empty for other
    files."""
    name = next(
        (n for n, width in _WIDTHS_OF_ZED.items() if size is not None and size[0] == width),
        "",
    )
    camera = trees.get(f"LEFT_CAM_{name}")
    return {} if camera is None else {f"LEFT_CAM_{name}": camera}


def _single_values(tree: Tree) -> dict[str, Any]:
    return {
        name: value for name, value in tree.items() if not isinstance(value, Mapping | list | tuple)
    }


def _lens_groups(tree: Tree) -> dict[str, Any]:
    """Groups and lists of a lens, which may stand beside the group of its focal lengths."""
    return {
        name: value
        for name, value in tree.items()
        if isinstance(value, Mapping | list | tuple) and _OF_A_LENS.fullmatch(str(name))
    }


def _model_of_values(
    values: Tree, size: tuple[int, int] | None, source: str, centre: float
) -> CameraModel:
    stored_size = _size(values) or size
    if stored_size is None:
        raise SequenceError(f"{source} lacks the size of the images; expected width and height")
    check_whole_sensor(values, stored_size, source)
    check_unchanged(values, source)
    centre = float(values.get("pixel_centre", centre))
    fisheye = _is_fisheye(values, source)
    coefficients = _coefficients(values, source, fisheye=fisheye)
    lens = {"distortion": coefficients, "fisheye": fisheye}
    names = next((names for names in _PINHOLES if set(names) <= values.keys()), None)
    if names is not None:
        return model_of(
            [float(values[name]) for name in names], stored_size, source, centre=centre, **lens
        )
    if _OPEN3D in values:
        column_major = _list_of(values[_OPEN3D])
        matrix = np.array(column_major).reshape(3, 3).T.ravel().tolist()
        return model_of_matrix(
            matrix, stored_size, f"{source}: {_OPEN3D} (column by column)", centre=centre, **lens
        )
    matrix_name = next((name for name in _MATRICES if name in values), None)
    if matrix_name is not None:
        matrix = _list_of(values[matrix_name])
        return model_of_matrix(
            matrix, stored_size, f"{source}: {matrix_name}", centre=centre, **lens
        )
    return model_of(_list_of(values[_FOUR]), stored_size, source, centre=centre, **lens)


def _size(values: Tree) -> tuple[int, int] | None:
    resolution = values.get("resolution")
    if isinstance(resolution, list | tuple) and len(resolution) == 2:
        return round(float(resolution[0])), round(float(resolution[1]))
    names = next((names for names in _SIZES if set(names) <= values.keys()), None)
    return (
        None if names is None else (round(float(values[names[0]])), round(float(values[names[1]])))
    )


def _list_of(value: Any) -> list[float]:
    """Numbers of a list, of rows, or of OpenCV's and ROS's matrices, which have ``data``."""
    if isinstance(value, Mapping):
        value = value["data"]
    return np.ravel(np.array(value, dtype=float)).tolist()


def _is_fisheye(values: Tree, source: str) -> bool:
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


def _coefficients(
    values: Tree,
    source: str,
    *,
    fisheye: bool,
) -> tuple[float, ...]:
    """The distortion in OpenCV's order; () where there is none."""
    names = _FISHEYE_COEFFICIENTS if fisheye else _COEFFICIENTS
    for name, value in values.items():
        is_known = name in names or name in _LISTS or name in ("is_fisheye", "fisheye", *_LENSES)
        if _OF_A_LENS.fullmatch(str(name)) and not is_known and is_not_zero(value):
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
    return _list_of(value)
