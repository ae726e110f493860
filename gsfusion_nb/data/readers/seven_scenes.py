"""Microsoft 7-Scenes (Shotton et al. 2013): a hand-held Kinect, poses from KinectFusion.

    redkitchen/seq-01/
      frame-000000.color.png    8-bit colour (some copies hold JPEG), not registered to the depth
      frame-000000.depth.png    16-bit, 1000 per metre; 0 and 65535 = missing
      frame-000000.pose.txt     4x4 camera-to-world matrix of the depth camera

Colour comes from another camera about 2 cm to the side with another focal length: 10 to 20 pixels
off.
"""

import logging
import math
from pathlib import Path

import torch

from ...errors import SequenceError
from ...types import Camera
from ..lens import CameraModel, Undistorter
from ..recorded.files import calibration_in, given_name, require
from ..recorded.poses import read_rows
from ..recorded.recorded_sequence import Layout, RecordedSequence

log = logging.getLogger(__name__)

LOOKS_FOR = ("frame-*.color.*", "frame-*.depth.png", "frame-*.pose.txt")
DEPTH_SCALE = 1000.0
DEPTH_INVALID = 65535

DEPTH_CAMERA = Camera(
    width=640,
    height=480,
    fx=585.0,
    fy=585.0,
    cx=320.5,
    cy=240.5,
)
"""585, 585, 320, 240 as published, pixel centres at integers there."""

COLOUR_LENS = CameraModel(
    Camera(width=640, height=480, fx=531.4116, fy=531.4116, cx=318.9184, cy=237.7222),
    (-0.024, 0.0, 0.0, 0.0, 0.0),
)
"""The colour camera, estimated by jointly refining poses and calibration on RedKitchen (not
published by Microsoft)."""

_ROLL = 0.0076046
"""Rotation of the colour camera about the depth camera's z axis, radians; same source."""

T_DEPTH_COLOUR = torch.tensor(
    [
        [math.cos(_ROLL), math.sin(_ROLL), 0.0, 0.019118],
        [-math.sin(_ROLL), math.cos(_ROLL), 0.0, -0.003662],
        [0.0, 0.0, 1.0, -0.014565],
        [0.0, 0.0, 0.0, 1.0],
    ],
    dtype=torch.float64,
)
"""Pose of the colour camera in the depth camera's frame, metres; same source."""


def seven_scenes(
    path: str | Path, *, register: bool = False, camera: Camera | None = None
) -> RecordedSequence:
    """Read a sequence of 7-Scenes (module docstring).

    Depth scale: 1000 per metre, 0 and 65535 missing. Poses: camera-to-world of the depth camera,
    OpenCV axes. Pixel centres: integers, so 0.5 is added to ``cx`` and ``cy``.

    Args:
        path: A ``seq-XX`` folder, or a scene with a single one.
        register: False: frames are those of the depth camera (f = 585), and colour is used as if it
            were the same camera's, so geometry is right and texture is 10 to 20 pixels off. True:
            frames are those of the colour camera; colour is undistorted, depth is warped into it
            with a z-buffer, poses are moved. Uses the calibration estimated on RedKitchen, which is
            right for other scenes only if they were recorded with the same Kinect.
        camera: Another camera than that of 7-Scenes, for colour and depth, which are then taken as
            registered.

    Raises:
        SequenceNotFoundError: the folder or a frame's pose is missing.
        SequenceError: no frames, several sequences, a pose file that does not hold 16 numbers, or a
            calibration beside the images, as 3DMatch, BundleFusion and other recordings with these
            names have: 7-Scenes has none.
    """
    root = _only_sequence(Path(path))
    require(root, LOOKS_FOR, "seven_scenes")
    calibration = calibration_in(*calibrated_folders(root))
    if calibration is not None and camera is None:
        raise SequenceError(
            f"{root} has the names of 7-Scenes, but a calibration of its own, {calibration}; it is "
            f"read by gsfusion-nb convert {root} OUT"
        )
    if register and camera is not None:
        raise SequenceError(
            f"{root}: register is the calibration of 7-Scenes, so it cannot be used with another "
            "camera"
        )
    colour = sorted(root.glob("frame-*.color.*"))
    stems = [path.name.partition(".")[0] for path in colour]
    pose_files = [root / f"{stem}.pose.txt" for stem in stems]
    poses = torch.stack([_read_pose(p) for p in pose_files])
    registration = Undistorter(COLOUR_LENS, DEPTH_CAMERA, T_DEPTH_COLOUR) if register else None
    if registration is None and camera is None:
        log.warning(
            "%s: colour is not registered to depth in 7-Scenes (10 to 20 pixels off); --reader "
            "register=true aligns it",
            root,
        )
    return RecordedSequence(
        name=given_name(root),
        camera=(camera or DEPTH_CAMERA) if registration is None else registration.camera,
        rgb_files=colour,
        depth_files=[root / f"{stem}.depth.png" for stem in stems],
        timestamps_s=[int(stem.removeprefix("frame-")) / 30.0 for stem in stems],
        poses=poses if registration is None else poses @ T_DEPTH_COLOUR,
        pose_sources=[str(p) for p in pose_files],
        depth_scale=DEPTH_SCALE,
        depth_invalid=(DEPTH_INVALID,),
        rectification=registration,
    )


def first_sequence(path: Path) -> Path:
    """The first ``seq-XX`` folder in ``path``, or ``path`` itself where there is none."""
    return min((p for p in path.glob("seq-*") if p.is_dir()), default=path)


def calibrated_folders(path: Path) -> list[Path]:
    """Folders that may hold the calibration of a folder of images: itself, and the scene around a
    ``seq-XX``."""
    folder = first_sequence(path)
    whole = folder.resolve()
    parents = [whole.parent] if whole.name.startswith("seq-") else []
    return list(dict.fromkeys([path, folder, *parents]))


def _only_sequence(path: Path) -> Path:
    sequences = sorted(p.name for p in path.glob("seq-*") if p.is_dir())
    if len(sequences) > 1:
        raise SequenceError(
            f"{path} holds several sequences; expected one of {', '.join(sequences)}"
        )
    return first_sequence(path)


def _read_pose(path: Path) -> torch.Tensor:
    rows = read_rows(path, 4, "a 4x4 camera-to-world matrix")
    if rows.shape != (4, 4):
        raise SequenceError(
            f"{path} must hold a 4x4 camera-to-world matrix, got {len(rows)} rows of 4"
        )
    return rows


LAYOUT = Layout(
    read=seven_scenes, looks_for=LOOKS_FOR, locate=first_sequence, registration={"register": True}
)
