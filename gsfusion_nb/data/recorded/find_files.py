"""Finding the files of a sequence on disk."""

import os
import re
from pathlib import Path

from ..sequence import SequenceError, SequenceNotFoundError


def given_name(folder: Path) -> str:
    """Name of a folder as it was given: of a symbolic link its own, not that of the folder it leads to."""
    return os.path.basename(os.path.abspath(folder))


def own_names(folder: Path) -> list[str]:
    """The names by which a folder may be recognised: as it was given and, of a link, that of the folder it leads to."""
    return [name for name in dict.fromkeys((given_name(folder), folder.resolve().name)) if name]


def require(root: Path, names: tuple[str, ...], layout: str, *, without_poses: str = "") -> None:
    """Raise ``SequenceNotFoundError`` unless ``root`` is a folder that holds all of ``names``.

    If only the file ``without_poses`` is missing, the message says how to read the sequence without poses.
    """
    if not root.is_dir():
        raise SequenceNotFoundError(f"{root} is not a folder; expected a sequence in the {layout!r} layout")
    lacking = missing(root, names)
    if lacking:
        advice = (
            ""
            if lacking != [without_poses]
            else ("; to estimate the poses instead: --tracking.poses tracked --reader poses=false")
        )
        raise SequenceNotFoundError(
            f"{root} lacks {', '.join(lacking)}; the {layout!r} layout is expected to have {', '.join(names)}{advice}"
        )


def missing(root: Path, names: tuple[str, ...]) -> list[str]:
    """Those of ``names`` that ``root`` lacks; a name may be a pattern such as ``seq-*``."""
    return [name for name in names if next(root.glob(name.rstrip("/")), None) is None]


def images_in(folder: Path, suffixes: tuple[str, ...] = (".jpg", ".jpeg", ".png")) -> list[Path]:
    """Images of a folder in natural order (2 before 10); hidden files are skipped. At least one, or an error."""
    if not folder.is_dir():
        raise SequenceNotFoundError(f"{folder} is not a folder; expected one with images")
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    if not found:
        raise SequenceError(f"{folder} holds no images; expected files ending in {', '.join(suffixes)}")
    return sorted(found, key=natural_order)


def pair_by_stem(rgb_files: list[Path], depth_files: list[Path]) -> list[Path]:
    """Depth file of every colour file, by name without suffix.

    Raises:
        SequenceError: a colour file without depth, or depth without colour; the message names the first.
    """
    depth_of = {p.stem: p for p in depth_files}
    for p in rgb_files:
        if p.stem not in depth_of:
            raise SequenceError(f"{depth_files[0].parent} has no depth image {p.stem}.png; expected one for {p}")
    stems = {p.stem for p in rgb_files}
    for p in depth_files:
        if p.stem not in stems:
            raise SequenceError(f"{rgb_files[0].parent} has no colour image {p.stem}; expected one for {p}")
    return [depth_of[p.stem] for p in rgb_files]


def natural_order(path: Path) -> list[tuple[int, int | str]]:
    """Sorting key of a file's name: 2 before 10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts if part]
