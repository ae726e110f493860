"""What only GSFusion reports: the quadtree of a frame, and why a map has hardly any Gaussians."""

from collections.abc import Sequence

from ..seeding import Cells
from ..types import Frame
from .few_seeds import LOOKED_AT, why_few
from .step_report import StepReport
from .tsdf_mapping import TsdfFiles, TsdfReports
from .usual_torch import in_usual_torch


class GSFusionFiles(TsdfFiles):
    """Files of a map whose seeds come from a quadtree."""

    @in_usual_torch
    def quadtree_cells(self, frame: Frame) -> Cells:
        """The quadtree of the frame's image (section III-B.1)."""
        return self.mapper.seed_context(frame).quadtree_cells()


class GSFusionReports(TsdfReports):
    """Reports that say why there are few seeds."""

    def step_warnings(self, frame: Frame, report: StepReport) -> list[str]:
        """Also why the first frames have given hardly any Gaussians, or no keyframe."""
        warnings = super().step_warnings(frame, report)
        reason = self._why_few() if self.mapper.n_frames == LOOKED_AT else ""
        return [*warnings, reason] if reason else warnings

    def run_notes(self, steps: Sequence[StepReport]) -> list[str]:
        """Also why the map has hardly any Gaussians, or no keyframe; a map without any is told
        elsewhere."""
        notes = super().run_notes(steps)
        reason = self._why_few() if len(self.mapper.gaussians) else ""
        return [*notes, reason] if reason else notes

    def _why_few(self) -> str:
        mapper = self.mapper
        n_gaussians = len(mapper.gaussians)
        n_keyframes = len(mapper.keyframes)
        return why_few(mapper.config, mapper.camera, mapper.n_frames, n_gaussians, n_keyframes)
