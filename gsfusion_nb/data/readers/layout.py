"""Finding the files of a sequence on disk."""

import json
import math
import re
from pathlib import Path
from typing import Any

from ...types import Camera
from ..protocol import SequenceError, SequenceNotFoundError


def require(root: Path, names: tuple[str, ...], layout: str, *, without_poses: str = "") -> None:
    """Raise ``SequenceNotFoundError`` unless ``root`` is a folder that holds all of ``names``.

    If only the file ``without_poses`` is missing, the message says how to go on without.
    """
    if not root.is_dir():
        raise SequenceNotFoundError(f"{root} is no folder; expected a sequence in the {layout!r} layout")
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
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    if not found:
        raise SequenceError(f"{folder} holds no images; expected files ending in {', '.join(suffixes)}")
    return sorted(found, key=natural_order)


def pair_by_stem(rgb_files: list[Path], depth_files: list[Path]) -> list[Path]:
    """Depth file of every colour file, by name without suffix.

    Raises:
        SequenceError: a colour file without depth, or depth without colour; names the first.
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


def read_json(path: Path, what: str) -> dict[str, Any]:
    """Object of a JSON file. Raises ``SequenceError`` when it is missing, damaged or no object."""
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise SequenceNotFoundError(f"{path} does not exist; expected {what}") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as e:
        raise SequenceError(f"{path} is no valid JSON ({e}); expected {what}") from None
    if not isinstance(values, dict):
        raise SequenceError(f"{path} must hold a JSON object ({what}), got a {type(values).__name__}")
    return values


def numbers(values: dict[str, Any], keys: tuple[str, ...], path: Path) -> dict[str, float]:
    """The values of ``keys``, which must all be there and be numbers, above zero but for ``cx`` and ``cy``.

    Raises:
        SequenceError: a missing key, a value that is no number, or one that is out of range; names the file.
    """
    lacking = [k for k in keys if k not in values]
    if lacking:
        raise SequenceError(f"{path} lacks {', '.join(lacking)}; expected the keys {', '.join(keys)}")
    for k in keys:
        value = values[k]
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise SequenceError(f"{path}: {k} must be a number, got {value!r}")
        if value <= 0 and k not in ("cx", "cy"):
            raise SequenceError(f"{path}: {k} must be > 0, got {value!r}")
    return {k: float(values[k]) for k in keys}


def camera(values: dict[str, Any], keys: tuple[str, str, str, str, str, str], path: Path, *, shift: float) -> Camera:
    """Camera of a JSON object.

    Args:
        values: The object.
        keys: Its keys for width, height, fx, fy, cx and cy.
        path: Its file, for messages.
        shift: Added to cx and cy: 0.5 where the file puts the centre of the first pixel at 0, 0 where at 0.5, pixels.

    Raises:
        SequenceError: a missing key, a value that is no number or out of range, or a size that is no whole number.
    """
    checked = numbers(values, keys, path)
    for k in keys[:2]:
        if checked[k] != int(checked[k]):
            raise SequenceError(f"{path}: {k} must be a whole number of pixels, got {checked[k]}")
    width, height, fx, fy, cx, cy = (checked[k] for k in keys)
    return Camera(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx + shift, cy=cy + shift)


def natural_order(path: Path) -> list[tuple[int, int | str]]:
    """Sorting key of a file's name: 2 before 10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts if part]
