"""Folders like those of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt, or
associations.txt.

Depth is 16-bit, 5000 per metre in the benchmark; in other recordings the unit is inferred
(``convert.depth_unit``). Poses "t tx ty tz qx qy qz qw" are camera-to-world with OpenCV axes. The
format holds no intrinsics. Those of the benchmark's cameras are known by the folder's name; for
other recordings they come from ``calibration.txt`` / ``camera.txt`` or the option.
"""

import os
from collections.abc import Sequence
from pathlib import Path

from ....data.recorded.times import read_image_list
from ..recording import ConvertOptions, Recording
from .image_recording import recording_of
from .pairing import FrameFiles, Numbered, judged, notes_on_times, paired, without_times

_ASSOCIATIONS = (
    "associations.txt",
    "association.txt",
    "associated.txt",
    "associate.txt",
    "assoc.txt",
)

LOOKS_FOR = "rgb.txt and depth.txt, or associations.txt"


def recognise(path: Path) -> bool:
    """Lists of images."""
    return (
        all((path / n).is_file() for n in ("rgb.txt", "depth.txt"))
        or associations_of(path) is not None
    )


def read(path: Path, options: ConvertOptions) -> Recording:
    """A folder with lists of images (module docstring)."""
    return recording_of(path, frames_of(path, options.image_time_unit), options)


def associations_of(path: Path) -> Path | None:
    """The list of pairs in a folder, if it has one."""
    return next((path / n for n in _ASSOCIATIONS if (path / n).is_file()), None)


def frames_of(path: Path, unit: str = "auto") -> FrameFiles:
    """The frames of a folder with lists.

    Numbers that are not times (``recorded.stamps``) neither sort nor pair the images: the list's
    order does, or that of the images' names.

    Args:
        path: The folder.
        unit: ``ConvertOptions.image_time_unit``.

    Raises:
        SequenceError: no lists, a damaged list, or images that cannot be paired.
    """
    file = associations_of(path)
    if file is not None:
        return _associated(file, unit)
    rgb, depth = judged([_numbered(path / "rgb.txt"), _numbered(path / "depth.txt")], unit)
    return paired(path, rgb, depth)


def _associated(file: Path, unit: str) -> FrameFiles:
    """Frames of lines "time file time file"; the file in a folder named depth is the depth image,
    else the second."""
    rows = []
    for first, second in read_image_list(file, per_line=2):
        first_is_depth = "depth" in os.path.relpath(first[1], file.parent).lower()
        rows.append((second, first) if first_is_depth else (first, second))
    kinds = [_numbered_lines(file, lines) for lines in zip(*rows, strict=True)]
    streams = judged(kinds, unit)
    timeless = next((s for s in streams if s.stamps.times_s is None), None)
    pairs = [(colour, depth) for (_, colour), (_, depth) in rows]
    if timeless is not None:
        return without_times(pairs, str(file), timeless.stamps)
    rgb_s, depth_s = (stream.stamps.times_s or [] for stream in streams)
    order = sorted(range(len(rows)), key=depth_s.__getitem__)
    return FrameFiles(
        [pairs[i] for i in order],
        [rgb_s[i] for i in order],
        [depth_s[i] for i in order],
        notes=notes_on_times(streams[1]),
    )


def _numbered(file: Path) -> Numbered:
    """Files and numbers of a list."""
    return _numbered_lines(file, [line for (line,) in read_image_list(file)])


def _numbered_lines(file: Path, lines: Sequence[tuple[float, Path]]) -> Numbered:
    return Numbered(
        str(file),
        [image for _, image in lines],
        [number for number, _ in lines],
        is_list=True,
    )
