"""Finding the files of a sequence on disk, and JSON files that describe its camera."""

import math
import os
import re
from collections.abc import Collection, Iterable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

from ...checks import shown
from ...errors import SequenceError, SequenceNotFoundError, refusing
from ...types import Camera


def given_name(folder: Path) -> str:
    """Name of a folder as it was given: of a symbolic link its own, not that of the folder it leads
    to."""
    return os.path.basename(os.path.abspath(folder))


def require(
    root: Path,
    names: tuple[str, ...],
    layout: str,
    *,
    without_poses: str = "",
) -> None:
    """Raise ``SequenceNotFoundError`` unless ``root`` is a folder that holds all of ``names``.

    If only the file ``without_poses`` is missing, the message says how to read the sequence without
    poses.
    """
    if not root.is_dir():
        raise SequenceNotFoundError(
            f"{root} is not a folder; expected a sequence in the {layout!r} layout"
        )
    lacking = missing(root, names)
    if lacking:
        advice = (
            ""
            if lacking != [without_poses]
            else ("; to estimate the poses instead: --tracking.poses tracked --reader poses=false")
        )
        raise SequenceNotFoundError(
            f"{root} lacks {', '.join(lacking)}; the {layout!r} layout is expected to have "
            f"{', '.join(names)}{advice}"
        )


def missing(root: Path, names: tuple[str, ...]) -> list[str]:
    """Those of ``names`` that ``root`` lacks; a name may be a pattern such as ``seq-*``."""
    return [name for name in names if next(root.glob(name.rstrip("/")), None) is None]


CALIBRATIONS = (
    "intrinsic/intrinsic_color.*",
    "intrinsic_color.*",
    "K.*",
    "intrinsic*",
    "calib*",
    "*calib/*.yaml",
    "SN*.conf",
    "camera_matrix.csv",
    "camera.*",
    "camera[_-]*",
    "cam_params.json",
    "*camchain*",
    "*intrinsics/*.pincam",
    "info.txt",
    "_info.txt",
)
"""Files and folders with which a recording gives the camera of its images, most telling first."""
CALIBRATION_SUFFIXES = (".txt", ".json", ".npy", ".yaml", ".yml", ".pincam", ".conf", ".csv")
_OF_POSES = re.compile(r"pose|traj|imu|odom", re.IGNORECASE)
"""In the name of a file that holds no camera."""


def calibration_in(*folders: Path) -> Path | None:
    """The first calibration file in some folders; None if there is none."""
    return next(calibrations_in(*folders), None)


def calibrations_in(*folders: Path) -> Iterator[Path]:
    """Calibration files in some folders, the most telling names of each folder first; one may come
    twice."""
    return (
        file
        for folder in folders
        for pattern in CALIBRATIONS
        for file in sorted(folder.glob(pattern))
        if file.suffix.lower() in CALIBRATION_SUFFIXES and not _OF_POSES.search(file.name)
    )


def first_of(
    folder: Path,
    patterns: Iterable[str],
    suffixes: Collection[str],
) -> Path | None:
    """The first file, or folder, that a pattern finds and that has one of the suffixes, those of
    earlier patterns first; None if there is none."""
    candidates = (
        p
        for pattern in patterns
        for p in sorted(folder.glob(pattern))
        if p.suffix.lower() in suffixes
    )
    return next(candidates, None)


def images_in(
    folder: Path, suffixes: tuple[str, ...] = (".jpg", ".jpeg", ".png", ".webp")
) -> list[Path]:
    """Images of a folder in natural order (2 before 10); hidden files are skipped. At least one, or
    an error."""
    if not folder.is_dir():
        raise SequenceNotFoundError(f"{folder} is not a folder; expected one with images")
    shown_files = (p for p in folder.iterdir() if not p.name.startswith("."))
    images = [p for p in shown_files if p.suffix.lower() in suffixes]
    if not images:
        raise SequenceError(
            f"{folder} holds no images; expected files ending in {', '.join(suffixes)}"
        )
    return sorted(images, key=natural_order)


def pair_by_stem(rgb_files: list[Path], depth_files: list[Path]) -> list[Path]:
    """Depth file of every colour file, by name without suffix.

    Raises:
        SequenceError: a colour file without depth, or depth without colour; the message names the
            first.
    """
    depth_of = {p.stem: p for p in depth_files}
    for p in rgb_files:
        if p.stem not in depth_of:
            raise SequenceError(
                f"{depth_files[0].parent} has no depth image {p.stem}.png; expected one for {p}"
            )
    stems = {p.stem for p in rgb_files}
    for p in depth_files:
        if p.stem not in stems:
            raise SequenceError(
                f"{rgb_files[0].parent} has no colour image {p.stem}; expected one for {p}"
            )
    return [depth_of[p.stem] for p in rgb_files]


def told_outside(folder: Path, files: Iterable[Path]) -> str:
    """A sentence on listed files that are not in the folder of their list; empty if all are.

    A list of somebody else's can name any file of this machine, whose content would then stand in a
    map.
    """
    root = Path(os.path.abspath(folder))
    outsiders = [file for file in files if not Path(os.path.abspath(file)).is_relative_to(root)]
    if not outsiders:
        return ""
    return (
        f"{len(outsiders)} of the listed images lie outside of {folder}, the first is "
        f"{os.path.abspath(outsiders[0])}"
    )


def natural_order(path: Path) -> list[tuple[int, int | Decimal | str]]:
    """Sorting key of a file's name: 2 before 10, and of names that end in a decimal number 7.03
    before 7.1."""
    decimal = re.fullmatch(r"(\D*)(\d+\.\d+)", path.stem)
    if decimal is not None:
        return (
            [(1, decimal[1]), (0, Decimal(decimal[2]))]
            if decimal[1]
            else [(0, Decimal(decimal[2]))]
        )
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts if part]


def numbers(
    values: dict[str, Any],
    keys: tuple[str, ...],
    path: Path,
) -> dict[str, float]:
    """The values of ``keys``, which must all be there and be numbers; all except ``cx`` and ``cy``
    must be positive.

    Raises:
        SequenceError: a missing key, a value that is not a number or is out of range; the message
            names the file.
    """
    lacking = [k for k in keys if k not in values]
    if lacking:
        raise SequenceError(
            f"{path} lacks {', '.join(lacking)}; expected the keys {', '.join(keys)}"
        )
    floats = {k: number(values, k, 0, path) for k in keys}
    for k in keys:
        if floats[k] <= 0 and k not in ("cx", "cy"):
            raise SequenceError(f"{path}: {k} must be > 0, got {shown(values[k])}")
    return floats


def number(
    values: dict[str, Any],
    key: str,
    default: float | int,
    source: str | Path,
) -> float:
    """The number at ``key``, or ``default`` where there is none. Raises ``SequenceError`` for
    anything else."""
    value = values.get(key, default)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value):
        raise SequenceError(f"{source}: {key} must be a number, got {shown(value)}")
    return float(value)


def camera(
    values: dict[str, Any],
    keys: tuple[str, str, str, str, str, str],
    path: Path,
    *,
    shift: float,
) -> Camera:
    """Camera of a JSON object.

    Args:
        values: The object.
        keys: Its keys for width, height, fx, fy, cx and cy.
        path: Its file, for messages.
        shift: Added to cx and cy: 0.5 where the file puts the centre of the first pixel at 0, 0
            where at 0.5, pixels.

    Raises:
        SequenceError: a missing key, a value that is not a number or is out of range, or a size
            that is not a whole number.
    """
    floats = numbers(values, keys, path)
    for k in keys[:2]:
        if floats[k] != int(floats[k]):
            raise SequenceError(f"{path}: {k} must be a whole number of pixels, got {floats[k]}")
    width, height, fx, fy, cx, cy = (floats[k] for k in keys)
    with refusing(f"{path}: "):
        return Camera(
            width=int(width),
            height=int(height),
            fx=fx,
            fy=fy,
            cx=cx + shift,
            cy=cy + shift,
        )
