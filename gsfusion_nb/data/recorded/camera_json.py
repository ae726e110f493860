"""JSON files that describe a camera, with errors that name the file and the key."""

import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...errors import shown
from ...types import Camera
from ..sequence import SequenceError


def numbers(values: dict[str, Any], keys: tuple[str, ...], path: Path) -> dict[str, float]:
    """The values of ``keys``, which must all be there and be numbers; all except ``cx`` and ``cy`` must be positive.

    Raises:
        SequenceError: a missing key, a value that is not a number or is out of range; the message names the file.
    """
    lacking = [k for k in keys if k not in values]
    if lacking:
        raise SequenceError(f"{path} lacks {', '.join(lacking)}; expected the keys {', '.join(keys)}")
    for k in keys:
        value = values[k]
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise SequenceError(f"{path}: {k} must be a number, got {shown(value)}")
        if value <= 0 and k not in ("cx", "cy"):
            raise SequenceError(f"{path}: {k} must be > 0, got {shown(value)}")
    return {k: float(values[k]) for k in keys}


def table(value: Any, source: str, what: str) -> Float[Tensor, "..."]:
    """Nested lists of numbers as a tensor, float64.

    Raises:
        SequenceError: text, ragged rows or numbers that are too large; names ``source``.
    """
    try:
        return torch.tensor(value, dtype=torch.float64)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        raise SequenceError(f"{source} must be {what}") from None


def number(values: dict[str, Any], key: str, default: float | int, source: str | Path) -> float:
    """The number at ``key``, or ``default`` where there is none. Raises ``SequenceError`` for anything else."""
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SequenceError(f"{source}: {key} must be a number, got {shown(value)}")
    return float(value)


def camera(values: dict[str, Any], keys: tuple[str, str, str, str, str, str], path: Path, *, shift: float) -> Camera:
    """Camera of a JSON object.

    Args:
        values: The object.
        keys: Its keys for width, height, fx, fy, cx and cy.
        path: Its file, for messages.
        shift: Added to cx and cy: 0.5 where the file puts the centre of the first pixel at 0, 0 where at 0.5, pixels.

    Raises:
        SequenceError: a missing key, a value that is not a number or is out of range, or a size that is not a whole
            number.
    """
    checked = numbers(values, keys, path)
    for k in keys[:2]:
        if checked[k] != int(checked[k]):
            raise SequenceError(f"{path}: {k} must be a whole number of pixels, got {checked[k]}")
    width, height, fx, fy, cx, cy = (checked[k] for k in keys)
    try:
        return Camera(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx + shift, cy=cy + shift)
    except ValueError as e:
        raise SequenceError(f"{path}: {e}") from None
