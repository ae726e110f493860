"""Baseline: pixels drawn at random, whatever the picture shows."""

from ...types import Seeds
from ..context import SeedContext
from ..rule import seeding_rule


@seeding_rule
def uniform(ctx: SeedContext, *, fraction: float = 0.05, required_weight: float = 1.0, coverage: bool = True) -> Seeds:
    """A random share of the pixels that have depth and lie in voxels observed for the first time, of equal image size.

    Each Gaussian represents 1 / fraction pixels and has the size that GSFusion gives a square cell of that area:
    radius sqrt(1 / (2 fraction)) pixels.

    Args:
        ctx: Frame and volume.
        fraction: Share of the candidate pixels that is seeded, 0..1, drawn without replacement.
        required_weight: Observation count that the voxel must have, as in the rule ``gsfusion``.
        coverage: False skips the voxel test; then every frame is seeded everywhere.

    Source: RTG-SLAM's uniform sampling of 5 % of a frame, with GSFusion's voxel test and size.
    """
    if not 0 < fraction <= 1:
        raise ValueError(f"uniform: fraction must be above 0 and at most 1, got {fraction}")
    seeds = ctx.seeds_at(ctx.pixels(), (0.5 / fraction) ** 0.5)
    if coverage:
        seeds = seeds[ctx.voxel_weight(seeds.xyz_W) == required_weight]
    return seeds[ctx.draw(len(seeds), round(fraction * len(seeds)))]
