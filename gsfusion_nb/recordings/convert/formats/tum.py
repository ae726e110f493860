"""Folders like those of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt; or images named by time.

Depth is 16-bit, 5000 per metre in the benchmark; in other recordings the unit is inferred (``convert.depth_unit``).
Poses "t tx ty tz qx qy qz qw" are camera-to-world with OpenCV axes. The format holds no intrinsics. Those of the
benchmark's cameras are known by the folder's name; for other recordings they come from ``calibration.txt`` /
``camera.txt`` or the option.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from ....checks import shown
from ....data.lens import CameraModel
from ....data.readers.tum import CALIBRATIONS, LENSES, MAX_TIME_DIFFERENCE_S, benchmark_camera
from ....data.recorded.files import images_in, natural_order
from ....data.recorded.images import read_rgb
from ....data.recorded.poses import read_words
from ....data.recorded.times import Stamps, associate, judge_stamps, read_image_list
from ....data.sequence import SequenceError
from ..camera import read_intrinsics
from ..depth_unit import find_depth_unit, some_depths
from ..recording import DEPTH_SUFFIXES, ConvertOptions, RecordedFrame, Recording, load_pair
from ..trajectory import Trajectory, read_trajectory

_ASSOCIATIONS = ("associations.txt", "association.txt", "associated.txt", "associate.txt", "assoc.txt")


@dataclass(frozen=True)
class TumFrames:
    """Colour and depth images of the frames in order."""

    pairs: list[tuple[Path, Path]]
    """Colour and depth file of each frame."""
    times_s: list[float] | None
    """When the depth images were taken, seconds; None: the recording has no times."""
    no_times: str = ""
    """Why it has none."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Depth images left out, by reason."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Stream:
    """Images of one kind."""

    source: str
    """The list, or the folder."""
    files: list[Path]
    stamps: Stamps


def associations_of(path: Path) -> Path | None:
    """The list of pairs in a folder, if it has one."""
    return next((path / n for n in _ASSOCIATIONS if (path / n).is_file()), None)


def frames_of(path: Path) -> TumFrames:
    """The frames of a TUM-style folder.

    Numbers that are not times (``recorded.times``) neither sort nor pair the images: the list's order does, or that of
    the images' names.

    Raises:
        SequenceError: no lists and no folders, a damaged list, or images that cannot be paired.
    """
    if not path.is_dir():
        raise SequenceError(f"{path} is not a folder; expected one with rgb.txt and depth.txt, or rgb/ and depth/")
    file = associations_of(path)
    if file is not None:
        return _associated(file)
    rgb, depth = (_stream(path, name) for name in ("rgb", "depth"))
    without = next((s for s in (depth, rgb) if s.stamps.times_s is None), None)
    if without is None:
        return _paired_by_time(path, rgb, depth)
    return _without_times(_paired_by_name(path, rgb.files, depth.files), without.source, without.stamps)


def _without_times(pairs: list[tuple[Path, Path]], source: str, stamps: Stamps) -> TumFrames:
    why = f"the numbers of {source} are not times: {stamps.why_not}"
    note = f"{why}; so frames are in the order of the list or folder, and no times or frame rate are written"
    return TumFrames(pairs, None, why, notes=(note,))


def _associated(file: Path) -> TumFrames:
    """Frames of lines "time file time file"; the file in a folder named depth is the depth image, else the second."""
    rows = []
    for number, words in read_words(file, "lines 'time rgb time depth'"):
        try:
            times, files = (float(words[0]), float(words[2])), [file.parent / words[1], file.parent / words[3]]
        except (ValueError, IndexError):
            times, files = (math.nan, math.nan), []
        if not all(map(math.isfinite, times)):
            raise SequenceError(f"{file} line {number} must be 'time file time file', got {shown(' '.join(words))}")
        depth = 0 if "depth" in words[1].lower() else 1
        rows.append((times[depth], files[1 - depth], files[depth]))
    stamps = judge_stamps([t for t, *_ in rows], names=[natural_order(depth) for *_, depth in rows])
    pairs = [(colour, depth) for _, colour, depth in rows]
    if stamps.times_s is None:
        return _without_times(pairs, str(file), stamps)
    order = sorted(range(len(rows)), key=stamps.times_s.__getitem__)
    notes = _notes(str(file), stamps)
    return TumFrames([pairs[i] for i in order], [stamps.times_s[i] for i in order], notes=notes)


def _notes(source: str, stamps: Stamps) -> tuple[str, ...]:
    """What was done to times that are not in order or not in seconds."""
    notes = [f"{source}: times were read as {stamps.unit}"] if stamps.unit != "s" else []
    if stamps.unordered:
        notes.append(f"{source} was sorted by time, which is also the order of its file names")
    return tuple(notes)


def _paired_by_time(path: Path, rgb: _Stream, depth: _Stream) -> TumFrames:
    depth_s, rgb_s = depth.stamps.times_s or [], rgb.stamps.times_s or []
    found = associate(depth_s, rgb_s, max_difference_s=MAX_TIME_DIFFERENCE_S)
    if not found:
        raise SequenceError(
            f"{path}: none of {len(depth_s)} depth images has a colour image within {MAX_TIME_DIFFERENCE_S} s; "
            "expected both to be named or listed with the times of one clock"
        )
    alone = len(depth_s) - len(found)
    return TumFrames(
        [(rgb.files[c], depth.files[d]) for d, c in found],
        [depth_s[d] for d, _ in found],
        dropped={"no colour image near in time": alone} if alone else {},
        notes=(*_notes(rgb.source, rgb.stamps), *_notes(depth.source, depth.stamps)),
    )


def _paired_by_name(path: Path, rgb: list[Path], depth: list[Path]) -> list[tuple[Path, Path]]:
    """Pairs in the order of the depth images: of the same name, else one by one."""
    colour_of = {p.stem: p for p in rgb}
    pairs = [(colour_of[p.stem], p) for p in depth if p.stem in colour_of]
    if pairs:
        return pairs
    if len(rgb) != len(depth):
        raise SequenceError(
            f"{path} has {len(rgb)} colour and {len(depth)} depth images without times, and their names do not pair "
            "them; expected associations.txt with lines 'time rgb time depth'"
        )
    return list(zip(rgb, depth, strict=True))


def _stream(path: Path, name: str) -> _Stream:
    """Files and times of a list, or of the images of a folder by their names."""
    file = path / f"{name}.txt"
    if not file.is_file():
        return _named_by_time(path, name)
    numbers, files = read_image_list(file)
    return _Stream(str(file), files, judge_stamps(numbers, names=[natural_order(f) for f in files]))


def _named_by_time(path: Path, name: str) -> _Stream:
    """The images of a folder, sorted by the times that are their names, or by name if these are no times."""
    folder = path / name
    if not folder.is_dir():
        raise SequenceError(f"{path} has neither {name}.txt nor {name}/; expected one of them")
    files = images_in(folder, DEPTH_SUFFIXES if name == "depth" else (".jpg", ".jpeg", ".png"))
    try:
        number_of = {p: float(p.stem) for p in files}
    except ValueError:
        return _Stream(str(folder), files, Stamps(None, "names are not numbers"))
    ordered = sorted(files, key=number_of.__getitem__)
    stamps = judge_stamps([number_of[p] for p in ordered])
    return _Stream(str(folder), files if stamps.times_s is None else ordered, stamps)


_TRAJECTORIES = ("groundtruth.txt", "poses.txt", "trajectory.txt", "CameraTrajectory.txt")

LOOKS_FOR = "rgb.txt and depth.txt, associations.txt, or rgb/ and depth/"


def recognise(path: Path) -> bool:
    """Lists, or folders rgb and depth."""
    lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
    return lists or associations_of(path) is not None or all((path / n).is_dir() for n in ("rgb", "depth"))


def read(path: Path, options: ConvertOptions) -> Recording:
    """A TUM-style folder (module docstring)."""
    found = frames_of(path)
    model, notes = _model(path, found.pairs[0][0], options)
    trajectory = _trajectory(path, found, options)
    notes = [*notes, *found.notes, *(trajectory.notes if trajectory else ())]
    times: list[float | None] = [*found.times_s] if found.times_s else [None] * len(found.pairs)
    poses = [None if trajectory is None or t is None else trajectory.pose_at(t) for t in times]
    scale = options.depth_scale
    if not scale:
        files = [depth for _, depth in found.pairs]
        scale, sentence = find_depth_unit(path, some_depths(files))
        notes.append(sentence)

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


def _model(path: Path, image: Path, options: ConvertOptions) -> tuple[CameraModel | None, list[str]]:
    """Camera of the options, of a calibration file or of the benchmark, if any, and a sentence that names it."""
    file = options.intrinsics or next((str(path / n) for n in CALIBRATIONS if (path / n).is_file()), "")
    known = benchmark_camera(path)
    if not file and not known:
        return None, []
    height, width = read_rgb(image).shape[:2]
    if file:
        centre = options.pixel_centre if options.intrinsics else 0.0
        return read_intrinsics(file, (width, height), centre=centre), [f"intrinsics from {file}"]
    if (LENSES[known].camera.width, LENSES[known].camera.height) != (width, height):
        return None, []
    return LENSES[known], [f"intrinsics of the TUM benchmark's {known}"]
