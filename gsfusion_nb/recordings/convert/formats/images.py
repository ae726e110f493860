"""Any folder of colour and depth images: which is which, pairs, poses and intrinsics under the
usual names.

Images of one kind have a folder, or a beginning or end of their names: color/ and depth/, or
frame-000000.color.jpg and frame-000000.depth.png. They are paired by the times or the numbers in
their names, else in order. Depth is 16-bit, floating point, NumPy or OpenEXR, registered to colour.
Where several kinds fit, an option decides.
"""

import re
from collections import defaultdict
from collections.abc import Set
from pathlib import Path

from ....data.recorded.files import images_in, natural_order
from ....errors import BadFrameError, SequenceError
from ..depth_files import DEPTH_SUFFIXES, read_depth_file
from ..recording import ConvertOptions, OptionNeeded, Recording
from .image_recording import recording_of
from .pairing import Numbered, judged, paired
from .unread import video_of_colour

COLOUR_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".webp")
_SUFFIXES = {"colour": COLOUR_SUFFIXES, "depth": DEPTH_SUFFIXES}
_SAYS = {"colour": re.compile(r"rgb|colou?r|image|img|photo"), "depth": re.compile(r"depth|range")}
_LARGEST_MATRIX = 16
"""Rows; a NumPy file with fewer is no image."""
_NEITHER = re.compile(r"conf|mask|label|semantic|instance|normal|preview|thumb")

LOOKS_FOR = (
    "images in folders such as color/ and depth/, or named such as color_0.png and depth_0.png"
)


def recognise(path: Path) -> bool:
    """A folder with images of depth."""
    return path.is_dir() and bool(_kinds(path)["depth"])


def read(path: Path, options: ConvertOptions) -> Recording:
    """A folder of images (module docstring)."""
    kinds = _kinds(path)
    depth = _numbered(path, "depth", kinds["depth"], options.depth)
    rgb = _numbered(path, "colour", kinds["colour"], options.colour)
    return recording_of(
        path,
        paired(path, *judged([rgb, depth], options.image_time_unit)),
        options,
    )


def _kinds(path: Path) -> dict[str, dict[str, list[Path]]]:
    """Kind of image -> pattern of names below the folder -> files; colour and depth."""
    groups = defaultdict(list)
    for level in ("*", "*/*", "*/*/*"):
        for file in sorted(path.glob(level), key=natural_order):
            name = file.relative_to(path).as_posix()
            if file.suffix.lower() in {*COLOUR_SUFFIXES, *DEPTH_SUFFIXES} and not re.search(
                r"(^|/)\.", name
            ):
                groups[re.sub(r"\d+([._]\d+)*", "*", name)].append(file)
    groups = {
        n: files for n, files in groups.items() if len(files) > 1 and not _NEITHER.search(n.lower())
    }
    depth_groups = {n for n, files in groups.items() if _is_stored_depth(files[0])}
    named_groups = {n for n in groups if _SAYS["depth"].search(n.lower())}
    fits = {
        "depth": depth_groups or named_groups,
        "colour": groups.keys() - depth_groups - named_groups,
    }
    return {
        kind: {n: groups[n] for n in _likely(names, _SAYS[kind])} for kind, names in fits.items()
    }


def _likely(
    names: Set[str],
    says: re.Pattern[str],
) -> Set[str]:
    """Of several names those that say what they are, and of these the ones in the fewest
    folders."""
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


def _numbered(
    path: Path,
    kind: str,
    fits: dict[str, list[Path]],
    given_pattern: str,
) -> Numbered:
    """The images of one kind: those that the option names, or the only ones that fit."""
    if given_pattern:
        folder = path / given_pattern if (path / given_pattern).is_dir() else Path(given_pattern)
        files = fits.get(given_pattern) or images_in(folder, _SUFFIXES[kind])
    elif len(fits) == 1:
        (given_pattern, files), *_ = fits.items()
    else:
        names = tuple(sorted(fits))
        if kind == "colour" and not fits and (advice := video_of_colour(path)):
            raise SequenceError(advice)
        raise OptionNeeded(
            f"{path} holds {'no images' if not fits else ', '.join(names)} that may be {kind}; "
            f"give --{kind} with a folder{' or one of these' if fits else ''}",
            option=kind,
            question=f"Which of these is {kind}?"
            if fits
            else f"Which folder holds the {kind} images?",
            choices=names,
        )
    source = str(path / given_pattern)
    texts = _varying_numbers([p.stem for p in files])
    if texts is None:
        return Numbered(source, files, None)
    is_padded = any(re.match(r"0\d", text) for text in texts)
    return Numbered(source, files, [float(text) for text in texts], padded=is_padded)


def _varying_numbers(stems: list[str]) -> list[str] | None:
    """The number in each name, as written; of several numbers the one that is not the same in all
    names.

    None where the names do not hold one such number each.
    """
    columns = [re.findall(r"\d+(?:\.\d+)?", stem) for stem in stems]
    if len({len(texts) for texts in columns}) != 1:
        return None
    varying = [
        texts for texts in zip(*columns, strict=True) if len(set(texts)) > 1 or len(columns[0]) == 1
    ]
    return list(varying[0]) if len(varying) == 1 else None
