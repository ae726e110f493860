"""From one frame to the next: is an image repeated while the camera moves, and do poses jump where
depth does not?"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...types import Frame

STILL_DEG = 0.1
STILL_M = 0.002
"""A camera that turns and moves by less from one frame to the next stands still."""
_JUMP_BASE_DEG = 1.0
_JUMP_BASE_M = 0.03
"""Shorter steps are not jumps."""
_JUMP_OF_MEDIAN = 1.5
"""A jump is longer than this many times the median of the steps around, ..."""
JUMP_ERROR = 0.01
_JUMP_ERROR_OF_USUAL = 4.0
"""... and depth then differs by this share and this many times the usual difference; the worst of
250 steps of a hand-held Kinect differs by 0.6 per cent, twice the usual."""
_JUMP_UNSEEN = 4.0
"""If two frames have nothing in common, a step is a jump if it is at least this many times the
median."""
STEPS_AROUND = 10
"""Steps before and after one that it is compared with."""


def repeated_image(a: Frame, b: Frame) -> str:
    """Which image of ``b`` is that of ``a``, pixel by pixel: "colour", "depth", "colour and depth",
    or "" for none.

    An image of one value, as of a white wall or without any depth, is the same wherever the camera
    is, and proves nothing.
    """
    same = {"colour": _is_same(a.colour, b.colour), "depth": _is_same(a.depth_m, b.depth_m)}
    return " and ".join(name for name, is_same in same.items() if is_same)


def _is_same(a: Tensor, b: Tensor) -> bool:
    return torch.equal(a, b) and bool((b != b.reshape(-1, *b.shape[2:])[0]).any())


def find_jumps(
    turned_deg: Float[np.ndarray, " F"],
    moved_m: Float[np.ndarray, " F"],
    error: Float[np.ndarray, " F"],
    frozen: Bool[np.ndarray, " F"],
) -> set[int]:
    """The steps that the depth images do not confirm: much longer than those around, and depth does
    not fit.

    Args:
        turned_deg, moved_m: How far the camera turned and moved in each step; NaN: unknown.
        error: Median relative depth difference between the two frames of each step; NaN if they see
            nothing in common.
        frozen: Steps from or to a repeated image, which cannot confirm poses.
    """
    step = np.maximum(turned_deg / _JUMP_BASE_DEG, moved_m / _JUMP_BASE_M)
    usual_error = float(np.nanmedian(error)) if np.isfinite(error).any() else 0.0
    jumps = set()
    for i in np.flatnonzero(np.isfinite(step)):
        neighbours = step[max(0, i - STEPS_AROUND) : i + STEPS_AROUND + 1]
        times = step[i] / max(np.nanmedian(neighbours), 1e-9)
        disagrees = (
            error[i] > max(JUMP_ERROR, _JUMP_ERROR_OF_USUAL * usual_error)
            and times > _JUMP_OF_MEDIAN
        )
        unseen = np.isnan(error[i]) and times > _JUMP_UNSEEN
        if step[i] > 1 and (disagrees or unseen) and not frozen[i]:
            jumps.add(int(i))
    return jumps
