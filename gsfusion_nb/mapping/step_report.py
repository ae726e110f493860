"""What one step of a mapper reports, and the clock that splits it into stages."""

import contextlib
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """One frame, mapped."""

    frame_index: int
    n_seeds: int
    """New Gaussians of this frame."""
    n_gaussians: int
    """Gaussians in the map after it."""
    is_keyframe: bool
    losses: tuple[float, ...]
    """Loss before each optimisation step on this frame."""
    psnr_before_db: float
    """PSNR of this view before it was optimised: GSFusion with its new Gaussians, RTG-SLAM without."""
    psnr_after_db: float
    """PSNR of this view after: GSFusion at the last step on it (before that step is taken), RTG-SLAM at the end."""
    n_blocks: int = 0
    """Voxel blocks in the TSDF map after it, if there is one."""
    counts: dict[str, int] = field(default_factory=dict)
    """RTG-SLAM: Gaussians by state, and how many changed state."""
    tracking: dict[str, Any] = field(default_factory=dict)
    """How the pose was found: status, rms_m, inlier_share. Empty for given poses."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time by stage: tracking, tsdf, quadtree, seeding, optimise, keyframes, states."""

    @property
    def total_seconds(self) -> float:
        """Wall time of the whole step."""
        return sum(self.seconds.values())


@dataclass(frozen=True, kw_only=True, eq=False)
class GlobalStep:
    """One view revisited in the optimisation after the scan."""

    pass_index: int
    """Which pass over the keyframes, from 0."""
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


class StageClock:
    """Adds up wall time by stage name: ``with clock("tsdf"): ...``."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def split(self, stage: str, part: str, seconds: float) -> None:
        """Count ``seconds`` of ``stage`` as ``part`` instead."""
        self.seconds[stage] -= seconds
        self.seconds[part] = self.seconds.get(part, 0.0) + seconds


def psnr_from_mse(mse: float) -> float:
    """PSNR in dB of images in 0..1; at most 100, which stands for equal images."""
    return -10 * math.log10(max(mse, 1e-10))
