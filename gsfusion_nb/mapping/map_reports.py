"""What a mapper reports: each frame in numbers, a whole run in numbers, and warnings in words."""

import math
from collections.abc import Sequence
from typing import Any

from ..types import Frame, Seeds
from .step_report import StepReport, psnr_from_mse

FAR_DEPTH_M = 30.0
"""A frame whose median depth is beyond this is doubtful: depth cameras measure up to 10 m."""


class MapReports:
    """The reports on a map, for runs and for the user; ``Mapper.reports``.

    Args:
        mapper: The ``Mapper`` whose map it is.
    """

    def __init__(self, mapper: Any):
        self.mapper = mapper
        self._told_far = False

    def of_frame(
        self,
        frame: Frame,
        seeds: Seeds,
        is_keyframe: bool,
        steps: Sequence[Sequence[float]] = (),
        **fields: Any,
    ) -> StepReport:
        """The report on a frame, from loss and mean squared error before each step on it
        (``as_floats``); ``fields`` are further ones of ``StepReport``."""
        psnrs_db = [psnr_from_mse(mse) for _, mse in steps] or [math.nan]
        measured = {
            "losses": tuple(loss for loss, _ in steps),
            "n_steps": len(steps),
            "psnr_before_db": psnrs_db[0],
            "psnr_after_db": psnrs_db[-1],
            "n_not_finite": self.mapper.lost.in_frame,
        }
        return StepReport(
            frame_index=frame.index,
            n_seeds=len(seeds),
            n_gaussians=len(self.mapper.gaussians),
            is_keyframe=is_keyframe,
            **measured | fields,
        )

    def counts(self) -> dict[str, int]:
        """Sizes of the map besides its Gaussians and keyframes, with their names in
        metrics.json."""
        return {}

    def run_metrics(self, steps: Sequence[StepReport]) -> dict[str, Any]:
        """Numbers of a whole run, from its steps, that only this system has; with their names in
        metrics.json."""
        return {}

    def run_notes(self, steps: Sequence[StepReport]) -> list[str]:
        """What the user should know of a whole run with these steps, as sentences."""
        return []

    def step_warnings(self, frame: Frame, report: StepReport) -> list[str]:
        """Warnings for the user about the step that gave ``report``, as sentences."""
        mapper = self.mapper
        warnings = []
        # the first; all are counted
        if report.n_not_finite and report.n_not_finite == mapper.lost.total:
            warnings.append(mapper.lost.in_words(f"frame {frame.index}"))
        if report.tracking.get("status") == "recovered":
            warnings.append(f"frame {frame.index}: tracking was lost and has recovered")
        if mapper.localiser.jump:
            warnings.append(f"frame {frame.index} was mapped although {mapper.localiser.jump}")
        depth_m = frame.depth_m[::8, ::8]
        if not self._told_far and bool(depth_m[depth_m > 0].median() > FAR_DEPTH_M):
            self._told_far = True
            warnings.append(
                f"frame {frame.index}, and perhaps later ones, has a median depth beyond "
                f"{FAR_DEPTH_M:g} m: is it a "
                "code for missing depth, or the wrong depth scale? --data.depth-max-m leaves it out"
            )
        return warnings
