"""The camera in a tree of names and values (``calibration_tree``), as other programs write it."""

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
from .lens_in_tree import OF_A_LENS, coefficients_of, is_fisheye_lens, list_of

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

_OF_PIXELS = re.compile(
    r"(?i)(\w+_)?(half_?pixel|pixel_?(cent(er|re)|offset|origin|convention)|origin)(_\w+)?"
)
_PIXEL_CENTRES = ("pixel_centre", "pixel_center")
_UNITS = re.compile(r"(?i)((focal|intrinsics?)_?)?units?")
_PIXELS = ("px", "pix", "pixel", "pixels", "m", "metre", "metres", "meter", "meters")
"""Units of intrinsics as they are read, or of what else a file may hold."""

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
    trees = cameras_in(tree)
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


def cameras_in(tree: Tree) -> dict[str, Tree]:
    """Each group of a tree that holds a camera, by its path of names."""
    return dict(_cameras(tree, ""))


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
        if isinstance(value, Mapping | list | tuple) and OF_A_LENS.fullmatch(str(name))
    }


def _model_of_values(
    values: Tree, size: tuple[int, int] | None, source: str, centre: float
) -> CameraModel:
    stored_size = _size(values) or size
    if stored_size is None:
        raise SequenceError(f"{source} lacks the size of the images; expected width and height")
    check_whole_sensor(values, stored_size, source)
    check_unchanged(values, source)
    _check_pixels(values, source)
    centre = next((float(values[name]) for name in _PIXEL_CENTRES if name in values), centre)
    fisheye = is_fisheye_lens(values, source)
    coefficients = coefficients_of(values, source, fisheye=fisheye)
    lens = {"distortion": coefficients, "fisheye": fisheye}
    names = next((names for names in _PINHOLES if set(names) <= values.keys()), None)
    if names is not None:
        return model_of(
            [float(values[name]) for name in names], stored_size, source, centre=centre, **lens
        )
    if _OPEN3D in values:
        column_major = list_of(values[_OPEN3D])
        matrix = np.array(column_major).reshape(3, 3).T.ravel().tolist()
        return model_of_matrix(
            matrix, stored_size, f"{source}: {_OPEN3D} (column by column)", centre=centre, **lens
        )
    matrix_name = next((name for name in _MATRICES if name in values), None)
    if matrix_name is not None:
        matrix = list_of(values[matrix_name])
        return model_of_matrix(
            matrix, stored_size, f"{source}: {matrix_name}", centre=centre, **lens
        )
    return model_of(list_of(values[_FOUR]), stored_size, source, centre=centre, **lens)


def _check_pixels(values: Tree, source: str) -> None:
    """Raise ``SequenceError`` where a name may say that intrinsics count other than in pixels, or
    from another place than ``pixel_centre`` can say."""
    for name, value in values.items():
        if _UNITS.fullmatch(name) and str(value).strip().lower() not in _PIXELS:
            raise SequenceError(
                f"{source}: {name} = {shown(value)} may say that the intrinsics are not in pixels; "
                "give them in pixels: --intrinsics 'fx fy cx cy [k1 k2 p1 p2 k3]'"
            )
        if name not in _PIXEL_CENTRES and _OF_PIXELS.fullmatch(name) and is_not_zero(value):
            raise SequenceError(
                f"{source}: {name} = {shown(value)} may say where pixels are counted from, which "
                "is not known here; expected pixel_centre, the centre of the first pixel: 0 "
                "(OpenCV, ROS) or 0.5 (COLMAP)"
            )


def _size(values: Tree) -> tuple[int, int] | None:
    """Width and height of the image, pixels, which some programs write as floats; None if they are
    not there."""
    resolution = values.get("resolution")
    if isinstance(resolution, list | tuple) and len(resolution) == 2:
        return round(float(resolution[0])), round(float(resolution[1]))
    for width, height in _SIZES:
        if width in values and height in values:
            return round(float(values[width])), round(float(values[height]))
    return None
