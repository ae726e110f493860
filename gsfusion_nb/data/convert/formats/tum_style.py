"""Folders like those of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt; or images named by time.

Depth is 16-bit, 5000 per metre unless ``depth_scale`` says otherwise; poses "t tx ty tz qx qy qz qw" are
camera-to-world with OpenCV axes. The format holds no intrinsics. Those of the benchmark's cameras are known by the
folder's name; for other recordings they come from ``calibration.txt`` / ``camera.txt`` or the option.
"""

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from ....errors import shown
from ...lens.camera_model import CameraModel
from ...readers.tum import DEPTH_SCALE, LENSES, MAX_TIME_DIFFERENCE_S
from ...recorded.associate import associate
from ...recorded.find_files import images_in
from ...recorded.poses import read_words
from ...sequence import SequenceError
from ..image_files import DEPTH_SUFFIXES, load_pair
from ..intrinsics import read_intrinsics
from ..options import ConvertOptions
from ..recording import RecordedFrame, Recording
from ..trajectory import read_trajectory

_ASSOCIATIONS = ("associations.txt", "association.txt", "associated.txt", "associate.txt", "assoc.txt")
_CALIBRATIONS = ("calibration.txt", "camera.txt", "calib.txt", "intrinsics.txt", "intrinsics.json", "camera.json")
_TRAJECTORIES = ("groundtruth.txt", "poses.txt", "trajectory.txt", "CameraTrajectory.txt")

Entry = tuple[float, Path, Path]
"""Time in seconds, colour file, depth file."""


def recognise(path: Path) -> bool:
    """Lists, or folders rgb and depth."""
    lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
    return lists or _associations(path) is not None or all((path / n).is_dir() for n in ("rgb", "depth"))


def read(path: Path, options: ConvertOptions) -> Recording:
    """A TUM-style folder (module docstring)."""
    entries, dropped = _entries(path)
    scale = options.depth_scale or DEPTH_SCALE
    model, notes = (None, []) if options.intrinsics else _model(path, entries[0][1])
    trajectory = None
    file = next((path / n for n in _TRAJECTORIES if (path / n).is_file()), None)
    if file is not None and not options.poses:
        trajectory = read_trajectory(file, time_unit=options.pose_time_unit, max_gap_s=options.max_gap_s)
        notes += list(trajectory.notes)

    def recorded_frames() -> Iterator[RecordedFrame]:
        for time_s, colour, depth in entries:
            pose = trajectory.pose_at(time_s) if trajectory else None
            yield RecordedFrame(
                source=str(colour), time_s=time_s, model=model, T_WC=pose, load=partial(load_pair, colour, depth, scale)
            )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(entries),
        depth_scale=scale,
        has_poses=trajectory is not None,
        dropped=dropped,
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
        raise SequenceError(
            f"{path} is not named by its time, and there is no rgb.txt with lines 'timestamp filename'; expected either"
        ) from None
    # 1e11 seconds are 3000 years, 1e17 nanoseconds are 3 years
    return value * (1e-9 if value > 1e17 else 1e-6 if value > 1e14 else 1e-3 if value > 1e11 else 1.0)


def _entries(path: Path) -> tuple[list[Entry], dict[str, int]]:
    """Frames with colour and depth in order of time, and how many images have no partner."""
    if not path.is_dir():
        raise SequenceError(f"{path} is not a folder; expected one with rgb.txt and depth.txt, or rgb/ and depth/")
    file = _associations(path)
    if file is not None:
        return _associated(file), {}
    rgb, depth = (_stream(path, name) for name in ("rgb", "depth"))
    pairs = associate([t for t, _ in depth], [t for t, _ in rgb], max_difference_s=MAX_TIME_DIFFERENCE_S)
    if not pairs:
        raise SequenceError(
            f"{path}: none of {len(depth)} depth images has a colour image within {MAX_TIME_DIFFERENCE_S} s; expected "
            "both to be named or listed with the times of one clock"
        )
    entries = [(depth[d][0], rgb[c][1], depth[d][1]) for d, c in pairs]
    alone = len(depth) - len(pairs)
    return entries, {"no colour image near in time": alone} if alone else {}


def _associations(path: Path) -> Path | None:
    return next((path / n for n in _ASSOCIATIONS if (path / n).is_file()), None)


def _associated(file: Path) -> list[Entry]:
    """Frames of lines "time file time file"; the file in a folder named depth is the depth image, else the second."""
    entries = []
    for number, words in read_words(file, "lines 'time rgb time depth'"):
        try:
            times, files = (float(words[0]), float(words[2])), [file.parent / words[1], file.parent / words[3]]
        except (ValueError, IndexError):
            times, files = (math.nan, math.nan), []
        if not all(map(math.isfinite, times)):
            raise SequenceError(f"{file} line {number} must be 'time file time file', got {shown(' '.join(words))}")
        depth = 0 if "depth" in words[1].lower() else 1
        entries.append((times[depth], files[1 - depth], files[depth]))
    return sorted(entries)


def _stream(path: Path, name: str) -> list[tuple[float, Path]]:
    """Times and files of a list, or of the images of a folder by their names."""
    file = path / f"{name}.txt"
    if not file.is_file():
        if not (path / name).is_dir():
            raise SequenceError(f"{path} has neither {name}.txt nor {name}/; expected one of them")
        suffixes = DEPTH_SUFFIXES if name == "depth" else (".jpg", ".jpeg", ".png")
        return [(time_of_name(p), p) for p in images_in(path / name, suffixes)]
    entries = []
    for number, words in read_words(file, "lines 'timestamp filename'"):
        try:
            time_s, image = float(words[0]), path / words[1]
        except (ValueError, IndexError):
            time_s, image = math.nan, path
        if not math.isfinite(time_s):
            raise SequenceError(f"{file} line {number} must be 'timestamp filename', got {shown(' '.join(words))}")
        entries.append((time_s, image))
    return entries


def _model(path: Path, image: Path) -> tuple[CameraModel | None, list[str]]:
    """Camera of a calibration file or of the benchmark, if there is one, and a sentence that names it."""
    file = next((path / n for n in _CALIBRATIONS if (path / n).is_file()), None)
    if file is not None:
        from ...recorded.images import read_rgb

        height, width = read_rgb(image).shape[:2]
        return read_intrinsics(str(file), (width, height)), [f"intrinsics from {file}, pixel centres at integers"]
    name = path.resolve().name
    known = next((n for n in LENSES if n in name or n.replace("freiburg", "fr") in name), None)
    if known is None:
        return None, []
    lens = LENSES[known]
    return CameraModel(lens.camera, lens.distortion), [f"intrinsics of the TUM benchmark's {known}"]
