"""Any folder of colour and depth images: which is which, pairs, poses and intrinsics under the usual names.

Images of one kind have a folder, or a beginning or end of their names: color/ and depth/, or frame-000000.color.jpg and
frame-000000.depth.png. They are paired by the times or the numbers in their names, else in order. Depth is 16-bit,
floating point, NumPy or OpenEXR, registered to colour. Where several kinds fit, an option decides.
"""

import contextlib
import itertools
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from ....data.lens import CameraModel
from ....data.readers.seven_scenes import calibrated_folders
from ....data.readers.tum import LENSES, MAX_TIME_DIFFERENCE_S, benchmark_camera
from ....data.recorded.files import (
    CALIBRATION_SUFFIXES,
    calibration_in,
    first_of,
    images_in,
    natural_order,
    told_outside,
)
from ....data.recorded.images import read_rgb
from ....data.recorded.times import Stamps, associate, common_unit, judge_stamps
from ....data.sequence import BadFrameError, SequenceError
from ....files import is_file
from ..depth_unit import find_depth_unit, some_depths
from ..focal_length import estimated_model
from ..intrinsics import read_intrinsics
from ..recording import (
    DEPTH_SUFFIXES,
    ConvertOptions,
    OptionNeeded,
    RecordedFrame,
    Recording,
    check_exr,
    load_pair,
    read_depth_file,
)
from ..trajectory import frame_key

COLOUR_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".webp")
_SUFFIXES = {"colour": COLOUR_SUFFIXES, "depth": DEPTH_SUFFIXES}
_SAYS = {"colour": re.compile(r"rgb|colou?r|image|img|photo"), "depth": re.compile(r"depth|range")}
_LARGEST_MATRIX = 16
"""Rows; a NumPy file with fewer is no image."""
_NEITHER = re.compile(r"conf|mask|label|semantic|instance|normal|preview|thumb")

LOOKS_FOR = "images in folders such as color/ and depth/, or named such as color_0.png and depth_0.png"


def recognise(path: Path) -> bool:
    """A folder with images of depth."""
    return path.is_dir() and bool(_kinds(path)["depth"])


def read(path: Path, options: ConvertOptions) -> Recording:
    """A folder of images (module docstring)."""
    kinds = _kinds(path)
    depth = _numbered(path, "depth", kinds["depth"], options.depth)
    rgb = _numbered(path, "colour", kinds["colour"], options.colour)
    return recording_of(path, paired(path, *judged([rgb, depth], options.image_time_unit)), options)


def _kinds(path: Path) -> dict[str, dict[str, list[Path]]]:
    """Kind of image -> pattern of names below the folder -> files; colour and depth."""
    groups = defaultdict(list)
    for level in ("*", "*/*", "*/*/*"):
        for file in sorted(path.glob(level), key=natural_order):
            name = file.relative_to(path).as_posix()
            if file.suffix.lower() in {*COLOUR_SUFFIXES, *DEPTH_SUFFIXES} and not re.search(r"(^|/)\.", name):
                groups[re.sub(r"\d+([._]\d+)*", "*", name)].append(file)
    groups = {n: files for n, files in groups.items() if len(files) > 1 and not _NEITHER.search(n.lower())}
    stored = {n for n, files in groups.items() if _is_stored_depth(files[0])}
    named = {n for n in groups if _SAYS["depth"].search(n.lower())}
    fits = {"depth": stored or named, "colour": groups.keys() - stored - named}
    return {kind: {n: groups[n] for n in _likely(names, _SAYS[kind])} for kind, names in fits.items()}


def _likely(names: Set[str], says: re.Pattern[str]) -> Set[str]:
    """Of several names those that say what they are, and of these the ones in the fewest folders."""
    names = {n for n in names if says.search(n.lower())} or names
    return {n for n in names if n.count("/") == min(m.count("/") for m in names)}


def _is_stored_depth(file: Path) -> bool:
    """Whether a file is as depth is stored: one channel of 16 bits or of floating point."""
    if file.suffix.lower() == ".exr":
        return True
    try:
        return read_depth_file(file, 1.0).shape[0] > _LARGEST_MATRIX
    except BadFrameError:
        return False


def _numbered(path: Path, kind: str, fits: dict[str, list[Path]], given: str) -> "Numbered":
    """The images of one kind: those that the option names, or the only ones that fit."""
    if given:
        folder = path / given if (path / given).is_dir() else Path(given)
        files = fits.get(given) or images_in(folder, _SUFFIXES[kind])
    elif len(fits) == 1:
        (given, files), *_ = fits.items()
    else:
        names = tuple(sorted(fits))
        raise OptionNeeded(
            f"{path} holds {'no images' if not fits else ', '.join(names)} that may be {kind}; "
            f"give --{kind} with a folder{' or one of these' if fits else ''}",
            option=kind,
            question=f"Which of these is {kind}?" if fits else f"Which folder holds the {kind} images?",
            choices=names,
        )
    source = str(path / given)
    texts = _varying_numbers([p.stem for p in files])
    if texts is None:
        return Numbered(source, files, None)
    padded = any(re.match(r"0\d", text) for text in texts)
    return Numbered(source, files, [float(text) for text in texts], padded=padded)


def _varying_numbers(stems: list[str]) -> list[str] | None:
    """The number in each name, as written; of several numbers the one that is not the same in all names.

    None where the names do not hold one such number each.
    """
    columns = [re.findall(r"\d+(?:\.\d+)?", stem) for stem in stems]
    if len({len(texts) for texts in columns}) != 1:
        return None
    varying = [texts for texts in zip(*columns, strict=True) if len(set(texts)) > 1 or len(columns[0]) == 1]
    return list(varying[0]) if len(varying) == 1 else None


@dataclass(frozen=True)
class Numbered:
    """Images of one kind, and the numbers in their names or beside them in a list, which may be times."""

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
    """Streams of images, whose numbers are all times of one unit, or which of them are no times and why.

    Args:
        kinds: The images of each kind.
        unit: ``ConvertOptions.image_time_unit``.
    """
    common = common_unit([kind.numbers for kind in kinds if kind.numbers])
    streams = []
    for kind in kinds:
        if kind.numbers is None:
            streams.append(Stream(kind.source, kind.files, Stamps(None, "names do not hold one number each")))
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
    """Frames of a colour and a depth image each: by their times, or by name where one kind has none.

    Raises:
        SequenceError: neither times nor names pair them.
    """
    without = next((s for s in (depth, rgb) if s.stamps.times_s is None), None)
    if without is None and _have_common_numbers(rgb, depth):
        return _paired_by_number(rgb, depth)
    if without is None:
        return _paired_by_time(path, rgb, depth)
    pairs = paired_by_name(path, rgb.files, depth.files)
    frames = without_times(pairs, without.source, without.stamps)
    return replace(frames, dropped=_left_out(rgb, depth, len(pairs)))


def _have_common_numbers(rgb: Stream, depth: Stream) -> bool:
    """Whether numbers that may be times or those of frames are mostly the same for both kinds of images."""
    rgb_s = set(rgb.stamps.times_s or [])
    depth_s = set(depth.stamps.times_s or [])
    may_count = rgb.stamps.is_guess and depth.stamps.is_guess
    return may_count and len(rgb_s & depth_s) >= 0.5 * min(len(rgb_s), len(depth_s))


def _paired_by_number(rgb: Stream, depth: Stream) -> FrameFiles:
    """Frames whose images have one number: a tolerance would pair images of different frames."""
    colour_at = dict(zip(rgb.stamps.times_s or [], rgb.files, strict=True))
    found = [(t, file) for t, file in zip(depth.stamps.times_s or [], depth.files, strict=True) if t in colour_at]
    return FrameFiles(
        [(colour_at[t], file) for t, file in found],
        [t for t, _ in found],
        dropped=_left_out(rgb, depth, len(found)),
        notes=(*notes_on_times(rgb), *notes_on_times(depth)),
    )


def without_times(pairs: list[tuple[Path, Path]], source: str, stamps: Stamps) -> FrameFiles:
    """Frames whose numbers are no times."""
    note = (
        f"the numbers of {source} are not times: {stamps.why_not}; so frames are in the order of the list or folder "
        "(--image-time-unit)"
    )
    return FrameFiles(pairs, None, notes=(note,))


def _left_out(rgb: Stream, depth: Stream, n_pairs: int) -> dict[str, int]:
    """Images without a partner of their number, by reason."""
    alone = {
        "no colour image of its number": len(depth.files) - n_pairs,
        "no depth image of its number": len(rgb.files) - n_pairs,
    }
    return {reason: n for reason, n in alone.items() if n > 0}


def notes_on_times(stream: Stream) -> tuple[str, ...]:
    """What was done to times that are not in order or not in seconds."""
    stamps = stream.stamps
    notes = []
    if stamps.is_guess:
        notes.append(
            f"{stream.source}: the numbers are taken as times in {stamps.unit}; if they only number the frames: "
            "--image-time-unit none"
        )
    elif stamps.unit != "s":
        notes.append(f"{stream.source}: times were read as {stamps.unit}")
    if stamps.unordered:
        notes.append(f"{stream.source} was sorted by time, which is also the order of its file names")
    return tuple(notes)


def _paired_by_time(path: Path, rgb: Stream, depth: Stream) -> FrameFiles:
    depth_s, rgb_s = depth.stamps.times_s or [], rgb.stamps.times_s or []
    found = associate(depth_s, rgb_s, max_difference_s=MAX_TIME_DIFFERENCE_S)
    if not found:
        raise SequenceError(
            f"{path}: none of {len(depth_s)} depth images has a colour image within {MAX_TIME_DIFFERENCE_S} s; "
            "expected both to be named or listed with the times of one clock"
        )
    alone = len(depth_s) - len(found)
    return FrameFiles(
        [(rgb.files[c], depth.files[d]) for d, c in found],
        [rgb_s[c] for _, c in found],
        [depth_s[d] for d, _ in found],
        dropped={"no colour image near in time": alone} if alone else {},
        notes=(*notes_on_times(rgb), *notes_on_times(depth)),
    )


def paired_by_name(path: Path, rgb: list[Path], depth: list[Path]) -> list[tuple[Path, Path]]:
    """Pairs in the order of the depth images: by the numbers in their names, else one by one."""
    colour_of = {frame_key(p.stem): p for p in rgb}
    pairs = [(colour_of[frame_key(p.stem)], p) for p in depth if frame_key(p.stem) in colour_of]
    if len({colour for colour, _ in pairs}) == len(pairs) > 0:
        return pairs
    if len(rgb) != len(depth):
        raise SequenceError(
            f"{path} has {len(rgb)} colour and {len(depth)} depth images without times, and their names do not pair "
            "them; expected associations.txt with lines 'time rgb time depth'"
        )
    return list(zip(rgb, depth, strict=True))


_OF_DEPTH = ("intrinsic/intrinsic_depth.*", "intrinsic_depth.*", "depth_intrinsic*")
_POSES = (
    "groundtruth.*",
    "poses.*",
    "pose.*",
    "*poses.*",
    "traj*",
    "*.traj",
    "CameraTrajectory.txt",
    "pos.*",
    "pose",
    "poses",
)


def recording_of(
    path: Path,
    found: FrameFiles,
    options: ConvertOptions,
    *,
    model: CameraModel | None = None,
    T_WC: Sequence[Float[Tensor, "4 4"] | None] = (),
) -> Recording:
    """The recording of pairs of images, with the camera, the poses and the unit of depth that the folder tells.

    Args:
        path, found, options: The folder, its frames, and how to read them.
        model: The camera, if the folder tells none.
        T_WC: Pose of each frame, None where it is unknown; by default those of a file in the folder.
    """
    check_exr(found.pairs[0][1])
    scale, unit = options.depth_scale, ()
    if not scale:
        scale, *unit = find_depth_unit(path, some_depths([depth for _, depth in found.pairs]))
    of_folder, about = _model(path, found, scale, options)
    model = of_folder or model
    of_depth = first_of(path, _OF_DEPTH, CALIBRATION_SUFFIXES)
    depth_model = None
    if of_depth:
        height, width = read_depth_file(next((d for _, d in found.pairs if is_file(d)), found.pairs[0][1]), 1.0).shape
        depth_model = read_intrinsics(str(of_depth), (width, height))
        about.append(f"intrinsics of depth from {of_depth}")
    images = found.pairs[0][0].parent
    poses = str(first_of(path, _POSES, (".txt", ".csv", ".npy", ".traj", "")) or "")  # folders have no suffix
    poses = poses or str(images) * any(images.glob("*pose.txt"))
    unknown = [None] * len(found.pairs)
    frames = [*zip(found.pairs, found.times_s or unknown, found.depth_times_s or unknown, T_WC or unknown, strict=True)]

    def recorded_frames() -> Iterator[RecordedFrame]:
        for (colour, depth), time_s, depth_time_s, T in frames:
            yield RecordedFrame(
                source=str(colour),
                time_s=time_s,
                depth_time_s=depth_time_s,
                model=model,
                depth_model=depth_model,
                T_WC=T,
                load=partial(load_pair, colour, depth, scale),
            )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(found.pairs),
        depth_scale=scale,
        has_poses=bool(poses or T_WC),
        poses_file="" if T_WC else poses,
        dropped=found.dropped,
        notes=(*about, *found.notes, *unit, *filter(None, [told_outside(path, itertools.chain(*found.pairs))])),
    )


def _model(
    path: Path, found: FrameFiles, scale: float, options: ConvertOptions
) -> tuple[CameraModel | None, list[str]]:
    """Camera of the options, of a calibration file or of the benchmark, if any, and a sentence that names it."""
    file = options.intrinsics or str(calibration_in(*calibrated_folders(path)) or "")
    if options.intrinsics == "estimate":
        model, sentence = estimated_model(found.pairs, scale)
        return model, [sentence]
    known = benchmark_camera(path)
    height, width = next(_sizes(found.pairs), (0, 0)) if file or known else (0, 0)
    if not height:
        return None, []
    if file:
        centre = options.pixel_centre if options.intrinsics else 0.0
        return read_intrinsics(file, (width, height), centre=centre), [f"intrinsics from {file}"]
    if (LENSES[known].camera.width, LENSES[known].camera.height) != (width, height):
        return None, []
    return LENSES[known], [f"intrinsics of the TUM benchmark's {known}"]


def _sizes(pairs: list[tuple[Path, Path]]) -> Iterator[tuple[int, ...]]:
    """Height and width of each colour image that can be read."""
    for colour, _ in pairs:
        with contextlib.suppress(BadFrameError):
            yield read_rgb(colour).shape[:2]
