"""GS-ICP SLAM's rule: a grid of pixels where the map no longer overlaps with the view, and every
thirty frames."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import torch

from ...geometry import quaternion, se3
from ...types import Seeds
from ..context import SeedContext
from ..draws import draw_rows
from ..map_rule import MapRule
from ..rule import seeding_rule, trained_otherwise
from ..shapes import MIN_SPACING_M

PRESETS = {"replica": (10, 5e-4, 0.7), "tum": (5, 1e-3, 0.81)}
"""Distance of the grid's pixels; distance up to which a point overlaps with the map; share of them
in a keyframe."""
LAST = "last_tracking_keyframe"
OPACITY = 0.1


@trained_otherwise("pruned every 200 steps")
@seeding_rule
@dataclass(frozen=True, kw_only=True)
class gs_icp(MapRule):
    """GS-ICP SLAM: a grid of pixels, where the map overlaps too little with the view, and every 30
    frames.

    In a frame that is a keyframe, all points of the grid (every 10th pixel of every 10th row) with
    depth. It is one for tracking if less than 70 % of its grid points are near a Gaussian of the
    map, and one for mapping every 30 frames after the last one for tracking. A Gaussian has the
    shape of its neighbourhood: its axes and standard deviations are those of the covariance of the
    nearest grid points, the standard deviations divided by max(2 z^1.5, 1) with the depth z in
    metres. Opacity 0.1.

    Args:
        preset: Grid and thresholds of the release: "replica" (10 pixels, 5e-4, 70 %), "tum" (5
            pixels, 1e-3, 81 %).
        density: Multiplies the number of points: those of a grid that is as fine as needed, of
            these as many as needed, drawn at random. Release: 1.
        keyframe_frames: A keyframe for mapping after this many frames; 0: none. Release: 30.
        neighbours: Number of points whose covariance is taken, the point itself included. 20 is
            usual in generalised ICP and is chosen here.
        squared: Whether the thresholds 5e-4 and 1e-3 are squared distances in m^2 (2.2 and 3.2 cm),
            or metres. Not known of the release; grid points are centimetres apart, so squared is
            taken.

    Left out: tracking by generalised ICP, the second overlap test, which only decides what tracking
    uses, and pruning every 200 steps (opacity 0.005, scale 0.1 of the extent). Standard deviations
    are at least 0.3 mm. Source: Ha et al. 2024 (GS-ICP SLAM) and its released code.
    """

    preset: Literal["replica", "tum"] = "replica"
    density: float = 1.0
    keyframe_frames: int = 30
    neighbours: int = 20
    squared: bool = True

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """All grid points, or none."""
        spacing, reach, share = PRESETS[self.preset]
        spacing /= self.density**0.5
        step = max(int(spacing), 1)
        grid = torch.zeros_like(ctx.frame.depth_m, dtype=torch.bool)
        grid[::step, ::step] = True
        uv = ctx.pixels(grid)
        uv = uv[draw_rows(ctx, len(uv), round(len(uv) * (step / spacing) ** 2))]
        seeds = ctx.seeds_at(uv, 1.0, opacity=OPACITY)
        if len(seeds) == 0:
            return seeds
        if not ctx.has_map or self._overlap(ctx, seeds, reach) < share:
            memory[LAST] = ctx.frame_number
        elif (
            not self.keyframe_frames
            or (ctx.frame_number - memory.get(LAST, 0)) % self.keyframe_frames
        ):
            return seeds[:0]
        return shaped_by_neighbours(ctx, seeds, self.neighbours)

    def _overlap(self, ctx: SeedContext, seeds: Seeds, reach: float) -> float:
        """Share of the points that have a Gaussian of the map nearby."""
        distance = ctx.nearest(seeds.xyz_W, 1, "map").distance_m[:, 0]
        return float(((distance.square() if self.squared else distance) < reach).float().mean())


def shaped_by_neighbours(ctx: SeedContext, seeds: Seeds, neighbours: int) -> Seeds:
    """The same seeds with axes and standard deviations of the points around each; fewer than 4
    points stay round."""
    k = min(neighbours, len(seeds)) - 1
    if k < 3:
        return seeds
    row = ctx.nearest(seeds.xyz_W, k).row
    neighbourhood = torch.cat([seeds.xyz_W[:, None], seeds.xyz_W[row]], dim=1).double()
    offset = neighbourhood - neighbourhood.mean(dim=1, keepdim=True)
    variance, axes = torch.linalg.eigh(offset.mT @ offset / (k + 1))
    axes = axes * torch.linalg.det(axes)[:, None, None].sign()  # a rotation, not a mirror
    z = se3.apply(se3.inverse(ctx.frame.T_WC), seeds.xyz_W)[:, 2:]
    scale_m = variance.clamp_min(0).sqrt().to(z) / (2 * z**1.5).clamp_min(1.0)
    quat = quaternion.from_matrix(axes).to(z)
    return dataclasses.replace(seeds, scale_m=scale_m.clamp_min(MIN_SPACING_M), quat=quat)
