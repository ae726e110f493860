"""Folders like those of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt, or associations.txt.

Depth is 16-bit, 5000 per metre in the benchmark; in other recordings the unit is inferred (``convert.depth_unit``).
Poses "t tx ty tz qx qy qz qw" are camera-to-world with OpenCV axes. The format holds no intrinsics. Those of the
benchmark's cameras are known by the folder's name; for other recordings they come from ``calibration.txt`` /
``camera.txt`` or the option.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from ....checks import shown
from ....data.recorded.files import natural_order
from ....data.recorded.poses import read_words
from ....data.recorded.times import Stamps, judge_stamps, read_image_list
from ....data.sequence import SequenceError
from ..recording import ConvertOptions, Recording
from .images import FrameFiles, Stream, notes_on_times, paired, recording_of, without_times

_ASSOCIATIONS = ("associations.txt", "association.txt", "associated.txt", "associate.txt", "assoc.txt")

LOOKS_FOR = "rgb.txt and depth.txt, or associations.txt"


def recognise(path: Path) -> bool:
    """Lists of images."""
    return all((path / n).is_file() for n in ("rgb.txt", "depth.txt")) or associations_of(path) is not None


def read(path: Path, options: ConvertOptions) -> Recording:
    """A folder with lists of images (module docstring)."""
    return recording_of(path, frames_of(path), options)


def associations_of(path: Path) -> Path | None:
    """The list of pairs in a folder, if it has one."""
    return next((path / n for n in _ASSOCIATIONS if (path / n).is_file()), None)


def frames_of(path: Path) -> FrameFiles:
    """The frames of a folder with lists.

    Numbers that are not times (``recorded.times``) neither sort nor pair the images: the list's order does, or that of
    the images' names.

    Raises:
        SequenceError: no lists, a damaged list, or images that cannot be paired.
    """
    file = associations_of(path)
    return paired(path, _stream(path, "rgb"), _stream(path, "depth")) if file is None else _associated(file)


def _associated(file: Path) -> FrameFiles:
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
        rows.append([(times[i], files[i]) for i in (1 - depth, depth)])
    streams = [Stream(str(file), [p for _, p in kind], _judged(kind)) for kind in zip(*rows, strict=True)]
    rgb_s, depth_s = (stream.stamps.times_s for stream in streams)
    pairs = [(colour, depth) for (_, colour), (_, depth) in rows]
    if rgb_s is None or depth_s is None:
        return without_times(pairs, str(file), next(s.stamps for s in streams if s.stamps.times_s is None))
    order = sorted(range(len(rows)), key=depth_s.__getitem__)
    return FrameFiles(
        [pairs[i] for i in order],
        [rgb_s[i] for i in order],
        [depth_s[i] for i in order],
        notes=notes_on_times(streams[1]),
    )


def _judged(lines: Sequence[tuple[float, Path]]) -> Stamps:
    return judge_stamps([number for number, _ in lines], names=[natural_order(file) for _, file in lines])


def _stream(path: Path, name: str) -> Stream:
    """Files and times of a list."""
    file = path / f"{name}.txt"
    numbers, files = read_image_list(file)
    return Stream(str(file), files, _judged([*zip(numbers, files, strict=True)]))
