"""Our rule: the Gaussians of ``edge_discs``, whose sizes and orientations learn four times as fast."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from ...types import Seeds
from ..context import SeedContext
from ..rule import MapRule, seeding_rule
from .edge_discs import edge_discs


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class edge_strokes(MapRule):
    """``edge_discs`` with learning rates of size and orientation that fit a map of few Gaussians.

    Adam moves a value by about its learning rate in a step. With the published 0.001 the size of a Gaussian that gets
    50 steps changes by about 5 per cent. That is enough where a Gaussian covers a pixel or two, but not where it covers
    a few dozen. With 0.004 sizes and directions follow the picture. The rule needs a system with the settings
    ``optim.lr_log_scale`` and ``optim.lr_quat``, such as GSFusion.

    Args:
        spacing_px: As in ``edge_discs``.
        radius: As in ``edge_discs``.
        stretch: As in ``edge_discs``.
        colour_window: As in ``edge_discs``.
        opacity: As in ``edge_discs``.
        thickness: As in ``edge_discs``.
        coverage: As in ``edge_discs``.

    Source: ours; docs/seeding_results.md has the comparison with the published rules.
    """

    spacing_px: float = 4.0
    radius: float = 0.7
    stretch: float = 4.0
    colour_window: float = 0.8
    opacity: float = 0.9
    thickness: float = 0.2
    coverage: bool = True

    overrides: ClassVar[Mapping[str, Any]] = {"optim__lr_log_scale": 4e-3, "optim__lr_quat": 4e-3}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        return edge_discs(
            ctx, spacing_px=self.spacing_px, radius=self.radius, stretch=self.stretch,
            colour_window=self.colour_window, opacity=self.opacity, thickness=self.thickness, coverage=self.coverage,
        )  # fmt: skip
