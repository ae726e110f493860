"""Baseline: every pixel becomes a Gaussian of its own size."""

from ...types import Seeds
from ..context import SeedContext
from ..rule import seeding_rule


@seeding_rule
def dense(ctx: SeedContext, *, required_weight: float = 1.0, coverage: bool = True) -> Seeds:
    """One Gaussian per pixel that has depth and lies in a voxel observed for the first time; radius z / fx, one pixel.

    Args:
        ctx: Frame and volume.
        required_weight: Observation count that the voxel must have, as in the rule ``gsfusion``.
        coverage: False skips the voxel test; then every pixel with depth is seeded in every frame.

    Source: the one-pixel footprint of SplaTAM, with GSFusion's voxel test in place of its silhouette test.
    """
    seeds = ctx.seeds_at(ctx.pixels(), 1.0)
    return seeds[ctx.voxel_weight(seeds.xyz_W) == required_weight] if coverage else seeds
