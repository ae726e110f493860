"""Frames of colour and depth images: by the times or the numbers in their names or lists, else one
by one."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ....data.readers.tum import MAX_TIME_DIFFERENCE_S
from ....data.recorded.files import natural_order
from ....data.recorded.stamps import Stamps, common_unit, judge_stamps
from ....data.recorded.times import associate
from ....errors import SequenceError
from ..trajectory import frame_key


@dataclass(frozen=True)
class Numbered:
    """Images of one kind, and the numbers in their names or beside them in a list, which may be
    times."""

    source: str
    """The list, or the folder."""
    files: list[Path]
    numbers: list[float] | None
    """None: their names do not hold one number each."""
    padded: bool = False
    """The numbers are written with leading zeros."""
    is_list: bool = False
    """The order is that of a list, not of a folder, which has none."""


def judged(kinds: Sequence[Numbered], unit: str) -> list["Stream"]:
    """Streams of images, whose numbers are all times of one unit, or which of them are no times and
    why.

    Args:
        kinds: The images of each kind.
        unit: ``ConvertOptions.image_time_unit``.
    """
    common = common_unit([kind.numbers for kind in kinds if kind.numbers])
    streams = []
    for kind in kinds:
        if kind.numbers is None:
            streams.append(
                Stream(kind.source, kind.files, Stamps(None, "names do not hold one number each"))
            )
            continue
        order = range(len(kind.files))
        if not kind.is_list:
            order = sorted(order, key=kind.numbers.__getitem__)
        stamps = judge_stamps(
            [kind.numbers[i] for i in order],
            names=[natural_order(file) for file in kind.files] if kind.is_list else (),
            unit=unit,
            common=common,
            padded=kind.padded,
        )
        files = kind.files if stamps.times_s is None else [kind.files[i] for i in order]
        streams.append(Stream(kind.source, files, stamps))
    return streams


@dataclass(frozen=True)
class FrameFiles:
    """Colour and depth images of the frames in order."""

    pairs: list[tuple[Path, Path]]
    """Colour and depth file of each frame."""
    times_s: list[float] | None
    """When the colour images were taken, seconds; None: the recording has no times."""
    depth_times_s: list[float] | None = None
    """When the depth images were taken, seconds; None: with the colour images."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Depth images left out, by reason."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Stream:
    """Images of one kind."""

    source: str
    """The list, or the folder."""
    files: list[Path]
    stamps: Stamps


def paired(path: Path, rgb: Stream, depth: Stream) -> FrameFiles:
    """Frames of a colour and a depth image each: by their times, or by name where one kind has
    none.

    Raises:
        SequenceError: neither times nor names pair them.
    """
    timeless = next((s for s in (depth, rgb) if s.stamps.times_s is None), None)
    if timeless is None and _have_common_numbers(rgb, depth):
        return _paired_by_number(rgb, depth)
    if timeless is None:
        return _paired_by_time(path, rgb, depth)
    pairs = paired_by_name(path, rgb.files, depth.files)
    frames = without_times(pairs, timeless.source, timeless.stamps)
    notes = (*frames.notes, *_note_on_first_numbers(rgb, depth, pairs))
    return replace(frames, dropped=_left_out(rgb, depth, len(pairs)), notes=notes)


def _have_common_numbers(rgb: Stream, depth: Stream) -> bool:
    """Whether numbers that may be times or those of frames are mostly the same for both kinds of
    images."""
    rgb_s = set(rgb.stamps.times_s or [])
    depth_s = set(depth.stamps.times_s or [])
    may_count = rgb.stamps.is_guess and depth.stamps.is_guess
    return may_count and len(rgb_s & depth_s) >= 0.5 * min(len(rgb_s), len(depth_s))


def _paired_by_number(rgb: Stream, depth: Stream) -> FrameFiles:
    """Frames whose images have one number: a tolerance would pair images of different frames."""
    colour_at = dict(zip(rgb.stamps.times_s or [], rgb.files, strict=True))
    pairs = [
        (t, file)
        for t, file in zip(depth.stamps.times_s or [], depth.files, strict=True)
        if t in colour_at
    ]
    return FrameFiles(
        [(colour_at[t], file) for t, file in pairs],
        [t for t, _ in pairs],
        dropped=_left_out(rgb, depth, len(pairs)),
        notes=(*notes_on_times(rgb), *notes_on_times(depth)),
    )


def without_times(
    pairs: list[tuple[Path, Path]],
    source: str,
    stamps: Stamps,
) -> FrameFiles:
    """Frames whose numbers are no times."""
    note = (
        f"the numbers of {source} are not times: {stamps.why_not}; so frames are in the order of "
        "the list or folder (--image-time-unit)"
    )
    return FrameFiles(pairs, None, notes=(note,))


def _left_out(rgb: Stream, depth: Stream, n_pairs: int) -> dict[str, int]:
    """Images without a partner of their number, by reason."""
    unpaired_numbers = {
        "no colour image of its number": len(depth.files) - n_pairs,
        "no depth image of its number": len(rgb.files) - n_pairs,
    }
    return {reason: n for reason, n in unpaired_numbers.items() if n > 0}


def _note_on_first_numbers(
    rgb: Stream, depth: Stream, pairs: list[tuple[Path, Path]]
) -> tuple[str, ...]:
    """What is said where as many images of both kinds are numbered from 0 and from 1."""
    keys: list[list[Any]] = [
        [frame_key(file.stem) for file in stream.files] for stream in (rgb, depth)
    ]
    if len(keys[0]) != len(keys[1]) or len(pairs) != len(keys[0]) - 1:
        return ()
    if not all(isinstance(key, tuple) and len(key) == 1 for kind in keys for key in kind):
        return ()
    first = [min(kind) for kind in keys]
    if sorted(first) != [(0,), (1,)]:
        return ()
    return (
        f"colour images are numbered from {first[0][0]} and depth images from {first[1][0]}, and "
        "those of one number were paired; if the first belongs to the first, rename one kind",
    )


def notes_on_times(stream: Stream) -> tuple[str, ...]:
    """What was done to times that are not in order or not in seconds."""
    stamps = stream.stamps
    notes = []
    if stamps.is_guess:
        notes.append(
            f"{stream.source}: the numbers are taken as times in {stamps.unit}; if they only "
            "number the frames: --image-time-unit none"
        )
    elif stamps.unit != "s":
        notes.append(f"{stream.source}: times were read as {stamps.unit}")
    if stamps.unordered:
        notes.append(
            f"{stream.source} was sorted by time, which is also the order of its file names"
        )
    return tuple(notes)


def _paired_by_time(path: Path, rgb: Stream, depth: Stream) -> FrameFiles:
    depth_s = depth.stamps.times_s or []
    rgb_s = rgb.stamps.times_s or []
    matches = associate(depth_s, rgb_s, max_difference_s=MAX_TIME_DIFFERENCE_S)
    if not matches:
        raise SequenceError(
            f"{path}: none of {len(depth_s)} depth images has a colour image within "
            f"{MAX_TIME_DIFFERENCE_S} s; "
            "expected both to be named or listed with the times of one clock"
        )
    n_unpaired = len(depth_s) - len(matches)
    return FrameFiles(
        [(rgb.files[c], depth.files[d]) for d, c in matches],
        [rgb_s[c] for _, c in matches],
        [depth_s[d] for d, _ in matches],
        dropped={"no colour image near in time": n_unpaired} if n_unpaired else {},
        notes=(*notes_on_times(rgb), *notes_on_times(depth)),
    )


def paired_by_name(
    path: Path,
    rgb: list[Path],
    depth: list[Path],
) -> list[tuple[Path, Path]]:
    """Pairs in the order of the depth images: by the numbers in their names, else one by one."""
    colour_of = {frame_key(p.stem): p for p in rgb}
    pairs = [(colour_of[frame_key(p.stem)], p) for p in depth if frame_key(p.stem) in colour_of]
    if len({colour for colour, _ in pairs}) == len(pairs) > 0:
        return pairs
    if len(rgb) != len(depth):
        raise SequenceError(
            f"{path} has {len(rgb)} colour and {len(depth)} depth images without times, and their "
            "names do not pair them; expected associations.txt with lines 'time rgb time depth'"
        )
    return list(zip(rgb, depth, strict=True))
