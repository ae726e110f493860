"""2DGS-SLAM's rule: random pixels in voxels that hold no Gaussian yet."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from ...types import Seeds
from ..context import SeedContext
from ..rule import KEYFRAMES, MapRule, When, seeding_rule
from ..sampling import as_discs, sized_by_neighbours

OPACITY = 0.999
MIN_DEPTH_M, MAX_DEPTH_M = 0.1, 10.0
MAX_OF_MEAN = 3.0


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class two_dgs_slam(MapRule):
    """2DGS-SLAM: in keyframes, discs for random pixels in voxels of 5 cm that hold no Gaussian yet.

    A random 10 % of the pixels with depth (0.1 to 10 m), of those the ones in voxels of 5 cm that hold no Gaussian of
    the map. Discs along the normals of the depth image, as large as the root mean square distance to their 3 nearest
    neighbours among all drawn points, also those in occupied voxels, but at most 3 times the mean of these.

    Args:
        share: Share of the pixels that is drawn at random, 0..1. Release: 0.1.
        voxel_size_m: Edge length of a voxel, metres. Release: 0.05.
        one_per_voxel: Of the new points that share a voxel keep only the first. As far as known the release keeps all,
            because it looks up only voxels that were occupied before.
        thickness: Third standard deviation as a share of the other two. The release has flat Gaussians without one; 0.1
            is chosen here.
        as_released: The release uses its setting ``initial_opacity: 0.999`` directly as a logit, so the opacity is
            sigmoid(0.999) = 0.73. False: 0.999.

    Depth below ``ctx.near_m`` counts as missing here. Left out because the optimiser does it: pruning by contribution,
    splitting and cloning where errors are large. Every 5th recorded frame is a keyframe unless the settings say
    otherwise.
    Source: the released code of 2DGS-SLAM (PRBonn).
    """

    share: float = 0.1
    voxel_size_m: float = 0.05
    one_per_voxel: bool = False
    thickness: float = 0.1
    as_released: bool = True

    when: ClassVar[When] = KEYFRAMES
    overrides: ClassVar[Mapping[str, Any]] = {"keyframe_every": 5}

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The discs of one keyframe."""
        uv = ctx.pixels((ctx.frame.depth_m >= MIN_DEPTH_M) & (ctx.frame.depth_m <= MAX_DEPTH_M))
        uv = uv[ctx.draw(len(uv), round(self.share * len(uv)))]
        opacity = float(torch.tensor(OPACITY).sigmoid()) if self.as_released else OPACITY
        seeds = ctx.seeds_at(uv, 1.0, opacity=opacity)
        free = ~ctx.occupied(seeds.xyz_W, self.voxel_size_m)
        if self.one_per_voxel:
            free &= ctx.first_in_voxel(seeds.xyz_W, self.voxel_size_m)
        seeds = sized_by_neighbours(ctx, seeds, max_of_mean=MAX_OF_MEAN)[free]  # sized before the voxel filter
        return as_discs(ctx, seeds, ctx.values_at(ctx.normals_W(), uv[free]), self.thickness)
