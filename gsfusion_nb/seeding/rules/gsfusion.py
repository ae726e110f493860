"""GSFusion's rule, and others by its voxel test: what the TSDF observes for the first time."""

import dataclasses
from dataclasses import dataclass
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from ...backends import piece
from ...config import SeedingConfig
from ...errors import ArgumentError
from ...gaussians import Edit
from ...types import Seeds
from ..context import SeedContext
from ..coverage import in_front
from ..depth_holes import cells_without_depth
from ..draws import draw_rows
from ..image_features import box_blur
from ..map_rule import MapRule, StepStats
from ..rule import seeding_rule


@seeding_rule
def gsfusion(
    ctx: SeedContext,
    *,
    required_weight: float = 1.0,
    coverage: bool = True,
    coarseness: float = 1.0,
) -> Seeds:
    """One Gaussian per quadtree leaf whose middle lies in a voxel that this frame was the first to
    observe.

    The voxel test runs after the frame has been integrated, so a weight of exactly 1 means "first
    observed now". In the released code as here, this has some consequences:
    - a voxel that was free space when first observed has a weight too: a surface that appears there
      later is never seeded;
    - a leaf is lost if the voxel around its middle has weight 0, because that voxel's own centre
      falls on a pixel without depth, or too far behind that pixel's depth (object borders);
    - a voxel is seeded twice if a later frame measures a point in it but does not update its
      weight;
    - several leaves of one frame may share a voxel.
    The last two cannot happen with ``one_per_voxel`` in the seeding settings.

    With ``without_depth = "sides"`` in the seeding settings there is also one Gaussian per leaf
    whose middle has no depth, where the map shows nothing; it has no voxel and no test
    (``cells_without_depth``).

    Args:
        ctx: Frame and volume.
        required_weight: Observation count that the voxel must have.
        coverage: False skips the voxel test; then every leaf with depth is seeded in every frame.
        coarseness: Factor of the size and of the standard deviation of colours above which a cell
            is cut. Larger: larger cells of both kinds, so fewer Gaussians. 1: as the settings say.

    Raises:
        ValueError: ``coarseness`` is not above 0.

    Source: GSFusion section III-B.2, Eq. 10; ``coarseness`` is ours.
    """
    if coarseness != 1:
        ctx = dataclasses.replace(ctx, config=coarser(ctx.config, coarseness))
    seeds = ctx.cells()
    seeds = seeds[first_seen(ctx.voxel_weight(seeds.xyz_W), required_weight)] if coverage else seeds
    return (
        Seeds.cat([seeds, cells_without_depth(ctx)])
        if ctx.config.without_depth == "sides"
        else seeds
    )


def coarser(config: SeedingConfig, factor: float) -> SeedingConfig:
    """The settings with a quadtree whose cells may be ``factor`` times as large, with colours that
    deviate ``factor`` times as much.

    Raises:
        ValueError: ``factor`` is not above 0.
    """
    if not factor > 0:
        raise ArgumentError(f"gsfusion: coarseness must be above 0, got {factor}")
    is_variance = config.quadtree_contrast == "released"
    threshold = config.quadtree_threshold * (factor**2 if is_variance else factor)
    return dataclasses.replace(
        config,
        quadtree_threshold=threshold,
        quadtree_largest_m=config.quadtree_largest_m * factor,
    )


@piece
def first_seen(weight: Float[Tensor, " N"], required_weight: float) -> Bool[Tensor, " N"]:
    """Which of the leaves with depth get a Gaussian, by the weight of the voxel around the middle
    of each."""
    return weight == required_weight


@seeding_rule
def dense(ctx: SeedContext, *, required_weight: float = 1.0, coverage: bool = True) -> Seeds:
    """One Gaussian per pixel that has depth and lies in a voxel observed for the first time; radius
    z / fx, one pixel.

    Args:
        ctx: Frame and volume.
        required_weight: Observation count that the voxel must have, as in the rule ``gsfusion``.
        coverage: False skips the voxel test; then every pixel with depth is seeded in every frame.

    Source: the one-pixel footprint of SplaTAM, with GSFusion's voxel test in place of its
    silhouette test.
    """
    seeds = ctx.seeds_at(ctx.pixels(), 1.0)
    return seeds[ctx.voxel_weight(seeds.xyz_W) == required_weight] if coverage else seeds


@seeding_rule
def uniform(
    ctx: SeedContext, *, fraction: float = 0.05, required_weight: float = 1.0, coverage: bool = True
) -> Seeds:
    """A random share of the pixels that have depth and lie in voxels observed for the first time,
    of equal image size.

    Each Gaussian represents 1 / fraction pixels and has the size that GSFusion gives a square cell
    of that area: radius sqrt(1 / (2 fraction)) pixels.

    Args:
        ctx: Frame and volume.
        fraction: Share of the candidate pixels that is seeded, 0..1, drawn without replacement.
        required_weight: Observation count that the voxel must have, as in the rule ``gsfusion``.
        coverage: False skips the voxel test; then every frame is seeded everywhere.

    Source: RTG-SLAM's uniform sampling of 5 % of a frame, with GSFusion's voxel test and size.
    """
    if not 0 < fraction <= 1:
        raise ArgumentError(f"uniform: fraction must be above 0 and at most 1, got {fraction}")
    seeds = ctx.seeds_at(ctx.pixels(), (0.5 / fraction) ** 0.5)
    if coverage:
        seeds = seeds[ctx.voxel_weight(seeds.xyz_W) == required_weight]
    return seeds[draw_rows(ctx, len(seeds), round(fraction * len(seeds)))]


SSIM_PX = 5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class vg_mapping(MapRule):
    """VG-Mapping: GSFusion's quadtree leaves where the scene is new or looks different; Gaussians
    in free space go.

    A leaf with depth gets a Gaussian where its voxel was not observed before this frame (weight up
    to 1), or where the structural similarity of the map's picture and the frame is below
    ``min_ssim`` at its middle. With the size d of a leaf, as in GSFusion (z times half its diagonal
    / fx), and the surface normal N, its standard deviations along the axes of the world are those
    of (15) and (16):

        n = 1 / (1 + |N|)  for each component,      S = d diag(n / |n|)

    so it is thinner along the axes that the normal is close to. After the first gradient step of a
    frame, the Gaussians are removed whose centres the frame sees through: those that lie in front
    of the measured depth by more than 1.5 cm and 1.5 voxels (17).

    Args:
        min_ssim: Leaves whose structural similarity (mean over R, G, B, in 5 x 5 pixels) is smaller
            are seeded.
        required_weight: Largest observation count of a voxel that counts as new.
        prunes: Whether Gaussians in free space are removed.

    The normal is that of the depth image; in the paper it is the gradient of the TSDF. Not read in
    the paper but in an independent public implementation of it: both thresholds, the margin, and
    that d is half a side of a square leaf. Left out: the TSDF's negative weights that let changed
    voxels follow faster. Source: He et al. 2025 (VG-Mapping, arXiv 2510.09962), equations 11 to 17.
    """

    min_ssim: float = 0.6
    required_weight: float = 1.0
    prunes: bool = True

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The leaves that have changed."""
        seeds = ctx.cells(largest_m=0.0, thickness=1.0, opacity=0.5)
        uv = ctx.quadtree_cells(largest_m=0.0).centre_uv
        uv = uv[ctx.values_at(ctx.has_depth(), uv)]  # those of the seeds
        has_changed = ctx.voxel_weight(seeds.xyz_W) <= self.required_weight
        if ctx.has_map:
            has_changed |= (
                ctx.values_at(similarity(ctx.render().rgb, ctx.frame.rgb), uv) < self.min_ssim
            )
        n = 1 / (1 + ctx.values_at(ctx.normals_W(), uv).abs())
        return dataclasses.replace(
            seeds,
            scale_m=seeds.scale_m * n / n.norm(dim=1, keepdim=True),
        )[has_changed]

    def after_step(
        self,
        ctx: SeedContext,
        stats: StepStats,
        memory: dict[str, Any],
    ) -> Edit | None:
        """Remove what the frame sees through."""
        if not self.prunes or stats.stage != "online" or stats.step_in_frame != 1:
            return None
        voxel_m = 0.0 if ctx.volume is None else ctx.volume.config.voxel_size_m
        is_gone = in_front(ctx, max(0.015, 1.5 * voxel_m))
        return Edit(keep=~is_gone) if is_gone.any() else None


def similarity(
    a: Float[Tensor, "H W 3"],
    b: Float[Tensor, "H W 3"],
) -> Float[Tensor, "H W"]:
    """Structural similarity around each pixel (Wang et al. 2004), mean over the channels: 1 where
    both are equal."""
    mean_a = box_blur(a, SSIM_PX)
    mean_b = box_blur(b, SSIM_PX)
    var_a = box_blur(a * a, SSIM_PX) - mean_a**2
    var_b = box_blur(b * b, SSIM_PX) - mean_b**2
    both = box_blur(a * b, SSIM_PX) - mean_a * mean_b
    light = (2 * mean_a * mean_b + SSIM_C1) / (mean_a**2 + mean_b**2 + SSIM_C1)
    return (light * (2 * both + SSIM_C2) / (var_a + var_b + SSIM_C2)).mean(dim=-1)
