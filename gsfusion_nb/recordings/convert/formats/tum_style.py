"""Folders like those of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt; or images named by time.

Depth is 16-bit, 5000 per metre in the benchmark; in other recordings the unit is inferred (``recorded.depth_unit``).
Poses "t tx ty tz qx qy qz qw" are camera-to-world with OpenCV axes. The format holds no intrinsics. Those of the
benchmark's cameras are known by the folder's name; for other recordings they come from ``calibration.txt`` /
``camera.txt`` or the option.
"""

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from ....data.lens.camera_model import CameraModel
from ....data.readers.tum import LENSES, benchmark_camera
from ....data.recorded.depth_unit import DepthUnit, find_depth_unit
from ....data.recorded.images import read_rgb
from ....data.sequence import BadFrameError, SequenceError
from ..image_files import load_pair
from ..intrinsics import read_intrinsics
from ..options import ConvertOptions
from ..pose_agreement import fits_poses, some_depths
from ..recording import RecordedFrame, Recording
from ..trajectory import Trajectory, read_trajectory
from .tum_frames import TumFrames, associations_of, frames_of

_CALIBRATIONS = ("calibration.txt", "camera.txt", "calib.txt", "intrinsics.txt", "intrinsics.json", "camera.json")
_TRAJECTORIES = ("groundtruth.txt", "poses.txt", "trajectory.txt", "CameraTrajectory.txt")


def recognise(path: Path) -> bool:
    """Lists, or folders rgb and depth."""
    lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
    return lists or associations_of(path) is not None or all((path / n).is_dir() for n in ("rgb", "depth"))


def read(path: Path, options: ConvertOptions) -> Recording:
    """A TUM-style folder (module docstring)."""
    found = frames_of(path)
    model, notes = (None, []) if options.intrinsics else _model(path, found.pairs[0][0])
    trajectory = _trajectory(path, found, options)
    notes = [*notes, *found.notes, *(trajectory.notes if trajectory else ())]
    times: list[float | None] = [*found.times_s] if found.times_s else [None] * len(found.pairs)
    poses = [None if trajectory is None or t is None else trajectory.pose_at(t) for t in times]
    scale = options.depth_scale
    if not scale:
        unit = _depth_unit(path, found, poses, model or _given_model(options, found))
        scale, notes = unit.scale, [*notes, unit.sentence]

    def recorded_frames() -> Iterator[RecordedFrame]:
        for time_s, pose, (colour, depth) in zip(times, poses, found.pairs, strict=True):
            yield RecordedFrame(
                source=str(colour), time_s=time_s, model=model, T_WC=pose, load=partial(load_pair, colour, depth, scale)
            )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(found.pairs),
        depth_scale=scale,
        has_poses=trajectory is not None,
        dropped=found.dropped,
        notes=tuple(notes),
    )


def time_of_name(path: Path) -> float:
    """Seconds of an image named by its time: "1305031102.175304" (seconds) or "1403636579763555584" (nanoseconds).

    Raises:
        SequenceError: the name is not a number.
    """
    try:
        value = float(path.stem)
        if not math.isfinite(value):
            raise ValueError(path.stem)
    except ValueError:
        raise SequenceError(f"{path} is not named by its time; expected a name such as 1305031102.175304.png") from None
    # 1e11 seconds are 3000 years, 1e17 nanoseconds are 3 years
    return value * (1e-9 if value > 1e17 else 1e-6 if value > 1e14 else 1e-3 if value > 1e11 else 1.0)


def _trajectory(path: Path, frames: TumFrames, options: ConvertOptions) -> Trajectory | None:
    """The trajectory beside the images, if there is one and the options name no other."""
    file = next((path / n for n in _TRAJECTORIES if (path / n).is_file()), None)
    if file is None or options.poses:
        return None
    if frames.times_s is None:
        raise SequenceError(
            f"{file} gives poses by time, but {frames.no_times}; correct the lists, or convert with --poses none and "
            "track the camera later"
        )
    return read_trajectory(file, time_unit=options.pose_time_unit, max_gap_s=options.max_gap_s)


def _depth_unit(
    path: Path, frames: TumFrames, poses: list[Float[Tensor, "4 4"] | None], model: CameraModel | None
) -> DepthUnit:
    """The unit of depth, from all evidence there is."""
    files = [depth for _, depth in frames.pairs]
    agreement = fits_poses(files, poses, model.camera) if model else {}
    return find_depth_unit(path, some_depths(files), agreement)


def _given_model(options: ConvertOptions, frames: TumFrames) -> CameraModel | None:
    if not options.intrinsics:
        return None
    try:
        height, width = read_rgb(frames.pairs[0][0]).shape[:2]
    except BadFrameError:
        return None
    return read_intrinsics(options.intrinsics, (width, height), centre=options.pixel_centre)


def _model(path: Path, image: Path) -> tuple[CameraModel | None, list[str]]:
    """Camera of a calibration file or of the benchmark, if there is one, and a sentence that names it."""
    file = next((path / n for n in _CALIBRATIONS if (path / n).is_file()), None)
    if file is not None:
        height, width = read_rgb(image).shape[:2]
        return read_intrinsics(str(file), (width, height)), [f"intrinsics from {file}, pixel centres at integers"]
    known = benchmark_camera(path)
    if not known:
        return None, []
    lens = LENSES[known]
    return CameraModel(lens.camera, lens.distortion), [f"intrinsics of the TUM benchmark's {known}"]
