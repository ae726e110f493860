"""JSON files that describe a camera, with errors that name the file and the key."""

import json
import math
from pathlib import Path
from typing import Any

from ...types import Camera
from ..sequence import SequenceError, SequenceNotFoundError


def read_json(path: Path, what: str) -> dict[str, Any]:
    """Object of a JSON file. Raises ``SequenceError`` when it is missing, damaged or no object."""
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise SequenceNotFoundError(f"{path} does not exist; expected {what}") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as e:
        raise SequenceError(f"{path} is not valid JSON ({e}); expected {what}") from None
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
