"""Open3D's reconstruction system and the Redwood data: color/, depth/, ``trajectory.log``,
``camera_intrinsic.json``.

The log holds camera-to-world matrices in blocks of five lines, the first of which begins with the
frame's number; a ``PinholeCameraTrajectory`` JSON holds column-major world-to-camera ones, with
intrinsics. Axes are OpenCV's, pixel centres at integers. Depth is in millimetres unless the
calibration or the camera's motion says otherwise. Redwood's names hold microseconds after the
number; without them times are the numbers of the frames at 30 a second.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ....data.lens import CameraModel
from ....data.recorded.files import images_in, natural_order
from ....errors import SequenceError, SequenceNotFoundError
from ....files import parsing, read_bytes, read_object, read_text
from ....geometry import se3
from ..camera_in_tree import model_of_tree
from ..depth_files import DEPTH_SUFFIXES
from ..recording import ConvertOptions, DepthUnit, Recording
from .image_recording import recording_of
from .pairing import FrameFiles, paired_by_name

_COLOUR = ("color", "image", "rgb", "images")
_TRAJECTORIES = (
    "trajectory.log",
    "scene/trajectory.log",
    "scene/integrated.log",
    "*.log",
    "trajectory.json",
)

LOOKS_FOR = "trajectory.log or .json, color/ and depth/"


def recognise(path: Path) -> bool:
    """A folder with a log and depth images."""
    return path.is_dir() and (path / "depth").is_dir() and _trajectory(path) is not None


def read(path: Path, options: ConvertOptions) -> Recording:
    """Images and the poses of a log (module docstring)."""
    colour_folder = next((path / n for n in _COLOUR if (path / n).is_dir()), None)
    if colour_folder is None or not (path / "depth").is_dir():
        raise SequenceNotFoundError(
            f"{path} lacks color/ or depth/; expected both beside trajectory.log"
        )
    colour = images_in(colour_folder)
    depth = images_in(path / "depth", DEPTH_SUFFIXES)
    frame_pairs = paired_by_name(path, colour, depth)
    # Redwood's names continue with the time: 0000001-000000033369.png
    numbers = [int(match[0]) for c, _ in frame_pairs if (match := re.search(r"\d+", c.stem))]
    numbers = (
        [n - numbers[0] for n in numbers]
        if len({*numbers}) == len(frame_pairs)
        else range(len(frame_pairs))
    )
    pairs = dict(zip(numbers, frame_pairs, strict=True))
    file = _trajectory(path)
    poses, model = ({}, None) if file is None else read_trajectory_file(file)
    # one pose per image: counted alike
    if len(poses) == len(pairs) <= max(pairs) and max(poses) < len(pairs):
        poses = dict(zip(pairs, poses.values(), strict=True))
    beyond = [i for i in poses if i > max(pairs)]
    if beyond:
        raise SequenceError(
            f"{file} has a pose of frame {beyond[0]}, but {path} holds {len(pairs)} images, from 0"
        )
    times_s, about_times = _times(pairs)
    files = FrameFiles([*pairs.values()], times_s, notes=(about_times,))
    T_WC = [poses.get(i) for i in pairs] if poses else ()
    recording = recording_of(path, files, options, model=model, T_WC=T_WC)
    if recording.unit is None or not recording.unit.is_guess:
        return recording
    in_millimetres = replace(options, depth_scale=_MILLIMETRES)
    recording = recording_of(path, files, in_millimetres, model=model, T_WC=T_WC)
    # a unit of the poses that the user gives says nothing of the unit of depth
    sentence = "depth was taken as 1000 units a metre, as Open3D's (--depth-scale)"
    unit = DepthUnit(_MILLIMETRES, sentence, is_guess=not options.scale)
    notes = recording.notes if unit.is_guess else (*recording.notes, sentence)
    return replace(recording, unit=unit, notes=notes)


_MILLIMETRES = 1000.0
_FRAMES_PER_S = 30


def _times(pairs: Mapping[int, tuple[Path, Path]]) -> tuple[list[float], str]:
    """Times of frames by their numbers, seconds, and what they are."""
    in_names = [re.fullmatch(r"\d+-(\d{6,})", colour.stem) for colour, _ in pairs.values()]
    times_s = [int(match[1]) / 1e6 for match in in_names if match]
    if len(times_s) == len(pairs):
        return times_s, "times are the microseconds of the images' names"
    return (
        [i / _FRAMES_PER_S for i in pairs],
        f"times are the numbers of the frames at {_FRAMES_PER_S} a second",
    )


def read_trajectory_file(path: Path) -> tuple[dict[int, Float[Tensor, "4 4"]], CameraModel | None]:
    """Camera-to-world poses by frame number of a .log or PinholeCameraTrajectory .json, and the
    latter's camera."""
    if path.suffix.lower() == ".json":
        return _read_json(path)
    lines = [
        line.split()
        for line in read_text(path, "Open3D's trajectory.log").splitlines()
        if line.strip()
    ]
    if not lines or len(lines) % 5:
        raise SequenceError(
            f"{path} has {len(lines)} lines; expected blocks of five, 'i i i+1' and four rows; is "
            "the file truncated?"
        )
    poses = {}
    with parsing(path, "blocks of 'i i i+1' and four rows of four numbers"):
        for at in range(0, len(lines), 5):
            rows = [[float(w) for w in row] for row in lines[at + 1 : at + 5]]
            poses[int(lines[at][0])] = torch.tensor(rows, dtype=torch.float64).reshape(4, 4)
    if len(poses) * 5 != len(lines):
        raise SequenceError(f"{path} has the pose of a frame twice")
    return poses, None


def _read_json(path: Path) -> tuple[dict[int, Float[Tensor, "4 4"]], CameraModel | None]:
    with parsing(
        path, "an Open3D PinholeCameraTrajectory, extrinsics of 16 numbers column by column"
    ):
        entries: Any = read_object(path, "an Open3D PinholeCameraTrajectory")["parameters"]
        extrinsics = torch.tensor(
            [entry["extrinsic"] for entry in entries], dtype=torch.float64
        ).reshape(-1, 4, 4)
        poses = dict(enumerate(se3.inverse(extrinsics.mT)))
        intrinsic = entries[0].get("intrinsic")
        return poses, None if intrinsic is None else model_of_tree(
            intrinsic, None, str(path), centre=0.0
        )


def _trajectory(path: Path) -> Path | None:
    candidates = (
        p
        for pattern in _TRAJECTORIES
        for p in sorted(path.glob(pattern), key=natural_order)
        if p.is_file()
    )
    return next(
        (
            p
            for p in candidates
            if p.suffix != ".json" or b'"parameters"' in read_bytes(p, "a trajectory")
        ),
        None,
    )
