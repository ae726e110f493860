"""The report on a mapped frame, and on a step after the scan."""

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..optim import ViewStep


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """Report on one mapped frame."""

    frame_index: int
    n_seeds: int
    """Number of new Gaussians from this frame."""
    n_gaussians: int
    """Number of Gaussians in the map after the step."""
    is_keyframe: bool
    losses: tuple[float, ...]
    """Loss before each optimisation step on this frame."""
    psnr_before_db: float = math.nan
    """PSNR of this view before its optimisation, dB; NaN if not measured. Each system decides
    whether its new Gaussians are drawn for it (GSFusion draws them, RTG-SLAM does not)."""
    psnr_after_db: float = math.nan
    """PSNR of this view after its optimisation, dB; NaN if not measured. A system may take the last
    value that needs no extra rendering (GSFusion: just before the last optimisation step; RTG-SLAM
    renders at the end of the step)."""
    n_steps: int = 0
    """Number of gradient steps in this frame, on any view."""
    n_not_finite: int = 0
    """Number of Gaussians that became NaN or infinite in these steps, and were removed."""
    n_blocks: int = 0
    """Number of voxel blocks in the TSDF map after the step, if there is one."""
    counts: dict[str, int] = field(default_factory=dict)
    """What only this system counts, by name, such as the number of Gaussians by state and of
    changes of state."""
    tracking: dict[str, Any] = field(default_factory=dict)
    """How the frame was tracked: status, rms_m, inlier_share. Empty for given poses."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time by stage. Each system names its stages, such as tsdf, seeding, optimise; "tracking"
    is the time for the pose, which a run reports separately. Compiling kernels is not counted."""

    @property
    def total_seconds(self) -> float:
        """Wall time of the whole step, without that of compiling kernels."""
        return sum(self.seconds.values())

    @property
    def in_words(self) -> str:
        """For a line of progress: the PSNR, if it was measured, and the number of Gaussians."""
        psnr = "" if math.isnan(self.psnr_after_db) else f"PSNR {self.psnr_after_db:.1f} dB, "
        return f"{psnr}{self.n_gaussians:,} Gaussians"


@dataclass(frozen=True, kw_only=True, eq=False)
class GlobalStep:
    """One step on one keyframe in the optimisation after the scan."""

    pass_index: int
    """Number of the pass over the keyframes, from 0."""
    step: int
    """Steps done so far in this optimisation, from 1."""
    n_steps: int
    """Steps in total."""
    loss_value: Float[Tensor, ""]
    """Loss before the step, on the device of the map."""

    @property
    def loss(self) -> float:
        """Loss before the step. On a GPU this waits until the step is done."""
        return float(self.loss_value)


def as_floats(steps: list[ViewStep]) -> list[list[float]]:
    """Loss and mean squared error of each step as numbers. A GPU is waited for once."""
    measured_steps = [torch.stack([step.loss, step.mse]) for step in steps if step.mse is not None]
    return torch.stack(measured_steps).tolist() if measured_steps else []


def psnr_from_mse(mse: float) -> float:
    """PSNR in dB of images in 0..1; at most 100, also for equal images."""
    return -10 * math.log10(max(mse, 1e-10))


def psnr_db(rgb: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> float:
    """PSNR of a picture as it is shown, clamped to 0..1."""
    return psnr_from_mse(float((rgb.clamp(0, 1) - target).square().mean()))
