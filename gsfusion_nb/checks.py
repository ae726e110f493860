"""Input checks whose errors are sentences: what was expected, what came."""

import math
import sys
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .errors import ArgumentError, UnknownNameError

SAVED_RIGIDITY_ERROR = 1e-2
"""Largest entry of R R^T - I in a pose of a checkpoint; tracking multiplies poses, so it may grow a
little."""


def shown(value: Any, at_most: int = 120) -> str:
    """A value that somebody else wrote, as one line short enough for a sentence: all messages quote
    with this.

    Text, and what holds more than ``at_most`` items, is cut before it is formatted.
    """
    if isinstance(value, str | bytes | list | tuple):
        value = value[: at_most + 1]
    text = repr(value)
    return text if len(text) <= at_most else f"{text[: at_most - 3]}..."


def check_shape(
    name: str,
    value: object,
    shape: tuple[int | str, ...],
) -> None:
    """Raise ``ValueError`` unless ``value`` is a tensor of the expected shape; a string stands for
    any length.

    Example: ``check_shape("depth_m", depth_m, ("H", "W"))``.
    """
    if not isinstance(value, Tensor):
        raise ArgumentError(f"{name} must be a torch.Tensor, got {type(value).__name__}")
    _check_size(name, tuple(value.shape), shape)


def check_array(
    name: str,
    value: object,
    shape: tuple[int | str, ...],
    dtype: type[np.generic],
) -> None:
    """Raise ``ValueError`` unless ``value`` is a NumPy array of this shape and type; a string
    stands for any length."""
    if not isinstance(value, np.ndarray):
        raise ArgumentError(f"{name} must be a numpy.ndarray, got {type(value).__name__}")
    if value.dtype != dtype:
        raise ArgumentError(
            f"{name} must be {np.dtype(dtype)}, got {value.dtype}; convert it with .astype()"
        )
    _check_size(name, value.shape, shape)


def _check_size(
    name: str,
    got: tuple[int, ...],
    shape: tuple[int | str, ...],
) -> None:
    if got == shape:
        return
    if len(got) != len(shape) or any(
        isinstance(e, int) and e != g for e, g in zip(shape, got, strict=True)
    ):
        sizes = ", ".join(str(e) for e in shape)
        raise ArgumentError(f"{name} must be [{sizes}], got {list(got)}")


def check_finite(name: str, value: Tensor) -> None:
    """Raise ``ValueError`` if ``value`` holds a NaN or an infinity, with the count and the first
    place."""
    bad = ~torch.isfinite(value)
    if bad.any():
        first = [int(i) for i in bad.nonzero()[0]]
        raise ArgumentError(
            f"{name} must be finite, got {int(bad.sum())} NaN or infinite values, the first at "
            f"{first}"
        )


def check_pose(name: str, T: Tensor, tolerance: float = 1e-3) -> None:
    """Raise ``ValueError`` unless ``T`` is a rigid 4x4 transform (finite, rotation orthonormal, no
    mirroring)."""
    check_shape(name, T, (4, 4))
    # on so few numbers torch takes more than twice as long
    numbers = T.detach().cpu().double().numpy()
    if not np.isfinite(numbers).all():
        check_finite(name, T)
    R = numbers[:3, :3]
    bottom = numbers[3]
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > tolerance:
        raise ArgumentError(
            f"{name} must be rigid: its rotation misses R R^T = I by {error:.2g} (allowed "
            f"{tolerance:.0e})"
        )
    if np.linalg.det(R) < 0:
        raise ArgumentError(
            f"{name} must be rigid: its rotation has determinant -1, so it mirrors the world"
        )
    if np.abs(bottom - [0.0, 0.0, 0.0, 1.0]).max() > tolerance:
        raise ArgumentError(
            f"{name} must end in the row [0, 0, 0, 1], got {[round(float(v), 4) for v in bottom]}"
        )


def check_colours(
    name: str,
    rgb: Tensor,
    extremes: tuple[float, float] | None = None,
) -> None:
    """Raise ``ValueError`` unless all of ``rgb`` is finite and in 0..1; ``extremes`` if they are
    known already."""
    if not rgb.numel():
        return
    low, high = extremes or torch.stack(torch.aminmax(rgb)).tolist()
    if not (math.isfinite(low) and math.isfinite(high)):  # the extremes of a NaN are NaN
        check_finite(name, rgb)
    if not (low >= -1e-3 and high <= 1 + 1e-3):
        raise ArgumentError(f"{name} must be in 0..1, got {low:g} to {high:g}")


def check_positive(name: str, value: object) -> None:
    """Raise ``ValueError`` unless ``value`` is a finite number above zero."""
    check_number(name, value)
    if not value > 0:  # pyright: ignore[reportOperatorIssue]
        raise ArgumentError(f"{name} must be > 0, got {value}")


def check_number(
    name: str,
    value: object,
    low: float | int = -math.inf,
    high: float | int = math.inf,
) -> None:
    """Raise ``ValueError`` unless ``value`` is a finite number from ``low`` to ``high``."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ArgumentError(f"{name} must be a number, got {shown(value)}")
    if not abs(value) <= sys.float_info.max:  # a whole number may be larger than any float
        raise ArgumentError(f"{name} must be finite, got {shown(value)}")
    if not low <= value <= high:
        limits = f">= {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
        raise ArgumentError(f"{name} must be {limits}, got {value}")


def check_device(name: str, device: str) -> None:
    """Raise ``ValueError`` with the reason if tensors cannot be on a device here."""
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as e:
        raise ArgumentError(
            f"{name} {device} cannot be used here, expected cpu or a CUDA device: "
            f"{str(e).splitlines()[0]}"
        ) from None


def check_name(kind: str, name: str, names) -> None:
    """Raise ``KeyError`` unless ``name`` is one of ``names``; the message lists them."""
    if name not in names:
        raise UnknownNameError(f"no {kind} {shown(name)}; known: {', '.join(sorted(names))}")


def check_saved(
    name: str,
    value: object,
    shape: tuple[int | str, ...],
    dtype: torch.dtype = torch.float32,
    *,
    finite: bool = True,
) -> None:
    """Raise ``ValueError`` unless ``value``, from a checkpoint, is a tensor of this shape and type,
    and finite."""
    check_shape(name, value, shape)
    assert isinstance(value, Tensor)
    if value.dtype != dtype:
        raise ArgumentError(f"{name} must be {dtype}, got {value.dtype}")
    if finite and value.is_floating_point():
        check_finite(name, value)


def check_whole(
    name: str,
    value: object,
    low: int,
    high: int | None = None,
) -> None:
    """Raise ``ValueError`` unless ``value`` is a whole number from ``low`` to ``high``, both
    allowed."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise ArgumentError(f"{name} must be a whole number, got {shown(value)}")
    if value < low or (high is not None and value > high):
        limits = f">= {low}" if high is None else f"between {low} and {high}"
        raise ArgumentError(f"{name} must be {limits}, got {value}")
