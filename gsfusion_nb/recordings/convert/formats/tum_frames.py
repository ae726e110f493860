"""Which frames a TUM-style folder has, in which order and at what times: from its lists or the names of its images."""

import math
from dataclasses import dataclass, field
from pathlib import Path

from ....data.readers.tum import MAX_TIME_DIFFERENCE_S
from ....data.recorded.associate import associate
from ....data.recorded.find_files import images_in, natural_order
from ....data.recorded.pose_lines import image_number
from ....data.recorded.poses import read_words
from ....data.recorded.stamps import Stamps, judge_stamps
from ....data.sequence import SequenceError
from ....errors import shown
from ..image_files import DEPTH_SUFFIXES

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

    Numbers that are not times (``recorded.stamps``) neither sort nor pair the images: the list's order does, or that of
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
    pairs, how, dropped = _paired_by_name(path, rgb.files, depth.files)
    why = f"the numbers of {without.source} are not times: {without.stamps.why_not}"
    return TumFrames(pairs, None, why, dropped, (_told(why, how),))


def _told(why: str, how: str) -> str:
    return f"{why}; so frames are in {how}, and no times or frame rate are written"


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
        why = f"the numbers of {file} are not times: {stamps.why_not}"
        return TumFrames(pairs, None, why, {}, (_told(why, "the order of the list"),))
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


def _paired_by_name(
    path: Path, rgb: list[Path], depth: list[Path]
) -> tuple[list[tuple[Path, Path]], str, dict[str, int]]:
    """Pairs in the order of the depth images, how they were found, and the depth images without a colour image."""
    for key, how in ((lambda p: p.stem, "names"), (image_number, "numbers in their names")):
        colour_of = {key(p): p for p in rgb}
        keys = [key(p) for p in depth]
        if len(colour_of) == len(rgb) and len(set(keys)) == len(keys) and None not in (*colour_of, *keys):
            pairs = [(colour_of[k], p) for k, p in zip(keys, depth, strict=True) if k in colour_of]
            if pairs:
                alone = len(depth) - len(pairs)
                dropped = {"no colour image of its name": alone} if alone else {}
                return pairs, f"the order of the list or folder, paired by the {how}", dropped
    if len(rgb) == len(depth):
        return list(zip(rgb, depth, strict=True)), "the order of the list or folder, paired one by one", {}
    raise SequenceError(
        f"{path} has {len(rgb)} colour and {len(depth)} depth images without times, and neither names nor numbers pair "
        "them; expected associations.txt with lines 'time rgb time depth'"
    )


def _stream(path: Path, name: str) -> _Stream:
    """Files and times of a list, or of the images of a folder by their names."""
    file = path / f"{name}.txt"
    if not file.is_file():
        return _named_by_time(path, name)
    numbers, files = [], []
    for number, words in read_words(file, "lines 'timestamp filename'"):
        try:
            value, image = float(words[0]), path / words[1]
        except (ValueError, IndexError):
            value, image = math.nan, path
        if not math.isfinite(value):
            raise SequenceError(f"{file} line {number} must be 'timestamp filename', got {shown(' '.join(words))}")
        numbers.append(value)
        files.append(image)
    return _Stream(str(file), files, judge_stamps(numbers, names=[natural_order(f) for f in files]))


def _named_by_time(path: Path, name: str) -> _Stream:
    """The images of a folder, sorted by the times that are their names, or by name if these are no times."""
    folder = path / name
    if not folder.is_dir():
        raise SequenceError(f"{path} has neither {name}.txt nor {name}/; expected one of them")
    files = images_in(folder, DEPTH_SUFFIXES if name == "depth" else (".jpg", ".jpeg", ".png"))
    try:
        number_of = {p: _number(p) for p in files}
    except ValueError as e:
        return _Stream(str(folder), files, Stamps(None, f"{e} is no number"))
    ordered = sorted(files, key=number_of.__getitem__)
    stamps = judge_stamps([number_of[p] for p in ordered])
    return _Stream(str(folder), files if stamps.times_s is None else ordered, stamps)


def _number(image: Path) -> float:
    """The number that is an image's name. Raises ``ValueError`` with the name."""
    try:
        value = float(image.stem)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(image.name)
    return value
