"""What a rule that is a class learns about each optimisation step."""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..errors import shown
from ..types import Camera

NEEDS = {
    "visibility": "``visible`` and ``radius_px``, and how often each Gaussian was visible",
    "image_gradients": "``v_uv``, and the mean length of it for each Gaussian",
    "abs_image_gradients": "``v_uv_abs``, and the mean length of it for each Gaussian",
    "render": "``rgb``",
}
"""What ``MapRule.needs`` may name, and what is then collected; both kinds of gradients include "visibility"."""


def check_needs(needs: frozenset[str], what: str) -> None:
    """Raise ``TypeError`` for names that ``NEEDS`` does not have; ``what`` begins the sentence."""
    if unknown := sorted(needs - NEEDS.keys(), key=str):
        raise TypeError(f"{what} must be among {', '.join(NEEDS)}, got {shown(unknown)}")


@dataclass(frozen=True, kw_only=True, eq=False)
class StepStats:
    """One gradient step, or the last of several if the map is written only after them (RTG-SLAM).

    Values for each Gaussian are those of the map before the step; N is its number of rows, which is the same after it.
    What only ``MapRule.needs`` makes the mapper collect is None without it.
    """

    step: int
    """Number of gradient steps of the map so far, this one included, from 1."""
    stage: Literal["online", "passes"]
    """While scanning, or in the passes over the keyframes after the scan."""
    step_in_frame: int
    """Number of gradient steps for this frame so far, from 1. In the passes after the scan: 1."""
    steps_in_frame: int
    """Number of gradient steps that there will be for this frame. In the passes after the scan: 1."""
    frame_index: int
    """Index of the frame or keyframe that was rendered and compared; online it may be an earlier one than
    ``ctx.frame``."""
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    """Camera and pose that were rendered."""
    target: Float[Tensor, "H W 3"]
    """The measured colours, 0..1."""
    loss: Float[Tensor, ""]
    """Loss before the step, on the device of the map."""
    rgb: Float[Tensor, "H W 3"] | None = None
    """The rendered picture before the step, with "render". Pixels that were not drawn are black (RTG-SLAM)."""
    visible: Bool[Tensor, " N"] | None = None
    """Whether each Gaussian reaches into the picture, hidden or not, with "visibility"."""
    radius_px: Float[Tensor, " N"] | None = None
    """Half of the longer side of the box in the picture outside which its alpha is below 1/255, pixels, 0 where not
    visible; with "visibility"."""
    v_uv: Float[Tensor, "N 2"] | None = None
    """dL/d of its centre in the picture, per pixel, with "image_gradients"; 0 where it was not optimised."""
    v_uv_abs: Float[Tensor, "N 2"] | None = None
    """The same, but the sum of the absolute values of what each pixel contributes to dL/du and dL/dv (Ye et al. 2024,
    AbsGS), with "abs_image_gradients"."""


VISIBLE, GRADIENT, ABS_GRADIENT = "times_visible", "image_gradient", "abs_image_gradient"
"""Names of the numbers that are summed up for each row: steps in which it was visible, and lengths of its ``v_uv`` and
of its ``v_uv_abs``."""


def add_up(
    gaussians: Any,
    visible: Bool[Tensor, " N"],
    v_uv: Float[Tensor, "N 2"] | None,
    camera: Camera,
    v_uv_abs: Float[Tensor, "N 2"] | None = None,
) -> None:
    """Add a step to the statistics of each row of a map, which ``times_visible``, ``image_gradient`` and
    ``abs_image_gradient`` read."""
    gaussians.row_memory(VISIBLE).add_(visible)
    for name, gradient in ((GRADIENT, v_uv), (ABS_GRADIENT, v_uv_abs)):
        if gradient is not None:
            length = (gradient * gradient.new_tensor([camera.width / 2, camera.height / 2])).norm(dim=1)
            gaussians.row_memory(name).add_(torch.where(visible, length, 0.0))


def times_visible(gaussians: Any) -> Float[Tensor, " N"] | None:
    """Number of gradient steps in which each Gaussian was visible since ``restart_statistics``; None if not collected.

    Source: Kerbl et al. 2023, section 5.2.
    """
    return gaussians.memory.get(VISIBLE)


def image_gradient(gaussians: Any) -> Float[Tensor, " N"] | None:
    """Mean length of dL/d of each centre in the image over the steps in which it was visible; None if not collected.

    The unit of length in the image is half its width and half its height, as in 3DGS and gsplat, whose threshold
    2e-4 refers to it.

    Source: Kerbl et al. 2023, section 5.2.
    """
    return _mean_over_steps(gaussians, GRADIENT)


def abs_image_gradient(gaussians: Any) -> Float[Tensor, " N"] | None:
    """Mean length of ``StepStats.v_uv_abs`` over the steps in which each Gaussian was visible; None if not collected.

    The unit of length in the image is that of ``image_gradient``, as in gsplat with ``absgrad=True``.

    Source: Ye et al. 2024 (AbsGS).
    """
    return _mean_over_steps(gaussians, ABS_GRADIENT)


def restart_statistics(gaussians: Any) -> None:
    """Forget what was summed up so far."""
    for name in (VISIBLE, GRADIENT, ABS_GRADIENT):
        if name in gaussians.memory:
            gaussians.memory[name].zero_()


def _mean_over_steps(gaussians: Any, name: str) -> Float[Tensor, " N"] | None:
    total = gaussians.memory.get(name)
    return None if total is None else total / gaussians.memory[VISIBLE].clamp_min(1)
