"""What the files of a recording say about its depth: the camera, where it stands, and the unit.

BundleFusion's and ScanNet's info.txt, ScanNet's exported ``intrinsic/``, ``scale`` of Replica's
cam_params.json, ``DepthMapFactor`` of ORB-SLAM, ``depth_scale`` of several programs.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...data.lens import CameraModel
from ...data.recorded.files import CALIBRATION_SUFFIXES, first_of
from ...errors import SequenceError
from ...geometry import se3
from .calibration_tree import Tree
from .camera_in_tree import cameras_in
from .camera_numbers import model_of_matrix
from .image_changes import is_no_motion
from .intrinsics import read_intrinsics
from .recording import DepthUnit
from .trajectory import read_matrix

_OF_DEPTH = (
    "intrinsic/intrinsic_depth.*",
    "intrinsic/intrinsics_depth.*",
    "intrinsic_depth.*",
    "intrinsics_depth.*",
    "depth_intrinsic*",
)
_PLACES = ("intrinsic/extrinsic_{}.txt", "extrinsic_{}.txt")
"""ScanNet's files of the colour and of the depth camera; {} is color or depth."""
_UNITS_PER_METRE = (
    "m_depthShift",
    "DepthMapFactor",
    "depth_map_factor",
    "png_depth_scale",
    "depth_factor",
)
"""Names of the stored depth of one metre: BundleFusion's, ORB-SLAM's, and those of SLAM systems
with Gaussians."""
_AMBIGUOUS = ("depth_scale", "scale")
"""Of several programs, with several meanings."""
_LEAST_PER_METRE = 10.0
_MOST_METRES = 0.02
"""A larger number is units per metre, a smaller one metres per unit (RealSense), between are
millimetres (BOP)."""
_POSSIBLE_M = (0.05, 200.0)
"""Medians of depth that a unit may give."""


def told_unit(
    tree: Tree, source: str, samples: Sequence[np.ndarray]
) -> tuple[DepthUnit | None, list[str]]:
    """The unit of depth that a calibration names, and a note where it names one that cannot be.

    Args:
        tree: Names and values of the calibration file.
        source: The file.
        samples: Some depth images as stored, 0 = missing. [H, W] each
    """
    scales = {
        name: scale for name, value in _numbers_in(tree) if (scale := _units_per_metre(name, value))
    }
    values = np.concatenate([image[image > 0].ravel() for image in samples] or [np.zeros(0)])
    if not scales or not len(values):
        return None, []
    if len(set(scales.values())) > 1:
        scales_text = ", ".join(f"{name} {scale:g}" for name, scale in scales.items())
        raise SequenceError(
            f"{source} names several units of depth, {scales_text} per metre; give --depth-scale"
        )
    ((name, scale), *_) = scales.items()
    middle_m = float(np.median(values)) / scale
    if not _POSSIBLE_M[0] <= middle_m <= _POSSIBLE_M[1]:
        return None, [
            f"{name} of {source} would make the median depth {middle_m:.3g} m, so it is not used"
        ]
    return DepthUnit(
        scale, f"depth was taken as {scale:g} units a metre, as {name} of {source} says"
    ), []


def _numbers_in(tree: Tree) -> Iterator[tuple[str, float]]:
    """Names and numbers of a tree and its groups, those of a depth stream's RealSense included."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _numbers_in(value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield str(name), float(value)


def _units_per_metre(name: str, value: float) -> float:
    """The stored depth of one metre that a name and its number say; 0 for other names."""
    if not value > 0:
        return 0.0
    if name in _UNITS_PER_METRE:
        return value
    if name not in _AMBIGUOUS:
        return 0.0
    if value >= _LEAST_PER_METRE:
        return value
    if name == "scale":
        return 0.0
    return 1.0 / value if value <= _MOST_METRES else 1000.0 / value


def depth_camera_beside(
    path: Path, tree: Tree, source: str, size: tuple[int, int]
) -> tuple[CameraModel | None, Float[Tensor, "4 4"] | None, list[str]]:
    """Camera of the depth images and its transform to the colour camera, as files beside the images
    say.

    Args:
        path: Folder of the recording.
        tree: Names and values of the colour camera's calibration file, which may hold that of
            depth, too.
        source: This file.
        size: Width and height of the depth images, pixels.

    Returns:
        The camera, None: depth is registered to colour; the transform, None: both stand at one
        place; and notes.

    Raises:
        SequenceError: the colour camera is not at the place of the poses.
    """
    model = None
    T = None
    notes = []
    own_file = first_of(path, _OF_DEPTH, CALIBRATION_SUFFIXES)
    if own_file is not None:
        model = read_intrinsics(str(own_file), size)
        notes.append(f"intrinsics of depth from {own_file}")
    elif "m_calibrationDepthIntrinsic" in tree:
        stored_size = (
            round(tree.get("m_depthWidth", size[0])),
            round(tree.get("m_depthHeight", size[1])),
        )
        matrix = [float(value) for value in np.ravel(tree["m_calibrationDepthIntrinsic"])]
        model = model_of_matrix(
            matrix, stored_size, f"{source}: m_calibrationDepthIntrinsic", centre=0.0
        )
        notes.append(f"intrinsics of depth from {source}")
    places = [_place(path, tree, kind) for kind in ("color", "depth")]
    if any(place is not None for place in places):
        T = _between(places[0], places[1], source or str(path))
    if T is not None:
        moved_mm = 1000 * float(T[:3, 3].norm())
        notes.append(f"depth was moved to colour, {moved_mm:.1f} mm from its camera")
    return model, T, notes


_SAYS_DEPTH = re.compile(r"(?i).*(depth|(^|[._])(ir|infra(red)?|tof))([._].*)?")
_DEPTH_TO_COLOUR = re.compile(
    r"(?i)(\w*depth\w*_?(to|2)_?(colou?r|rgb)\w*|\w*(colou?r|rgb)\w*_?(to|2)_?depth\w*"
    r"|t_?(colou?r|rgb)_?(depth|d)|t_?(depth|d)_?(colou?r|rgb)|(depth_?)?extrinsics?)"
)


def notes_on_a_second_camera(tree: Tree, source: str) -> list[str]:
    """What is said about a camera of depth that a calibration holds beside that of colour, where
    depth is taken as registered to colour.

    Raises:
        SequenceError: the file says where one camera stands beside the other, in a way that is not
            known.
    """
    for name, value in tree.items():
        if _DEPTH_TO_COLOUR.fullmatch(name) and not is_no_motion(value):
            raise SequenceError(
                f"{source}: {name} says where the depth camera stands beside the colour camera; "
                "if depth is to be moved to colour: --T-colour-depth FILE and --depth-intrinsics; "
                "if that was done before: --depth-intrinsics colour"
            )
    cameras = cameras_in(tree)
    depth = [name for name in cameras if _SAYS_DEPTH.fullmatch(name)]
    if not depth or len(cameras) == len(depth):
        return []
    return [
        f"{source} also holds the camera {depth[0]}; depth is taken as registered to colour "
        "(--depth-intrinsics)"
    ]


def poses_of_a_robot(poses: Path, tree: Tree) -> str:
    """A sentence on poses of RTAB-Map that are those of the robot, not of its camera; empty for
    others."""
    is_rtabmaps = (
        "local_transform" in tree
        and poses.name.endswith("poses.txt")
        and "camera" not in poses.name
    )
    if not is_rtabmaps:
        return ""
    return (
        f"{poses} holds the poses of the robot's base, beside a calibration of RTAB-Map with a "
        "local_transform; export those of the camera with rtabmap-export --poses_camera, or say "
        "that they are the camera's: --poses FILE"
    )


def _place(
    path: Path,
    tree: Tree,
    kind: str,
) -> Float[Tensor, "4 4"] | None:
    """From a camera to the rig that the poses are of."""
    file = next(
        (path / name.format(kind) for name in _PLACES if (path / name.format(kind)).is_file()),
        None,
    )
    if file is not None:
        return read_matrix(file)
    values: Any = tree.get(f"m_calibration{kind.capitalize()}Extrinsic")
    return (
        None
        if values is None
        else torch.tensor(np.ravel(values).tolist(), dtype=torch.float64).reshape(4, 4)
    )


def _between(
    T_rig_colour: Float[Tensor, "4 4"] | None,
    T_rig_depth: Float[Tensor, "4 4"] | None,
    source: str,
) -> Float[Tensor, "4 4"] | None:
    """From the depth camera to the colour camera; None where they are at one place."""
    one = torch.eye(4, dtype=torch.float64)
    colour = one if T_rig_colour is None else T_rig_colour
    depth = one if T_rig_depth is None else T_rig_depth
    if not torch.allclose(colour, one, atol=1e-5):
        raise SequenceError(
            f"{source}: the colour camera is not where the poses are, as its extrinsic matrix "
            "says; give that matrix "
            "with --T-body-cam FILE, and that from depth to colour with --T-colour-depth FILE"
        )
    T = se3.inverse(colour) @ depth
    return None if torch.allclose(T, one, atol=1e-5) else T
