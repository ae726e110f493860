"""VG-Mapping's rule: quadtree leaves where picture or geometry has changed; what lies in free space is removed."""

import dataclasses
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ...gaussians import Edit
from ...types import Seeds
from ..context import SeedContext
from ..image_features import box_blur
from ..rule import MapRule, StepStats, seeding_rule
from ..sampling import in_front

SSIM_PX, SSIM_C1, SSIM_C2 = 5, 0.01**2, 0.03**2


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class vg_mapping(MapRule):
    """VG-Mapping: GSFusion's quadtree leaves where the scene is new or looks different; Gaussians in free space go.

    A leaf with depth gets a Gaussian where its voxel was not observed before this frame (weight up to 1), or where the
    structural similarity of the map's picture and the frame is below ``min_ssim`` at its middle. With the size d of a
    leaf, as in GSFusion (z times half its diagonal / fx), and the surface normal N, its standard deviations along the
    axes of the world are those of (15) and (16):

        n = 1 / (1 + |N|)  for each component,      S = d diag(n / |n|)

    so it is thinner along the axes that the normal is close to. After the first gradient step of a frame, the Gaussians
    are removed whose centres the frame sees through: those that lie in front of the measured depth by more than 1.5 cm
    and 1.5 voxels (17).

    Args:
        min_ssim: Leaves whose structural similarity (mean over R, G, B, in 5 x 5 pixels) is smaller are seeded.
        required_weight: Largest observation count of a voxel that counts as new.
        prunes: Whether Gaussians in free space are removed.

    The normal is that of the depth image; in the paper it is the gradient of the TSDF. Not read in the paper but in an
    independent public implementation of it: both thresholds, the margin, and that d is half a side of a square leaf.
    Left out: the TSDF's negative weights that let changed voxels follow faster.
    Source: He et al. 2025 (VG-Mapping, arXiv 2510.09962), equations 11 to 17.
    """

    min_ssim: float = 0.6
    required_weight: float = 1.0
    prunes: bool = True

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """The leaves that have changed."""
        seeds, uv = ctx.cells(), ctx.quadtree_cells().centre_uv
        uv = uv[ctx.values_at(ctx.has_depth(), uv)]  # those of the seeds
        changed = ctx.voxel_weight(seeds.xyz_W) <= self.required_weight
        if ctx.has_map:
            changed |= ctx.values_at(similarity(ctx.render().rgb, ctx.frame.rgb), uv) < self.min_ssim
        n = 1 / (1 + ctx.values_at(ctx.normals_W(), uv).abs())
        return dataclasses.replace(seeds, scale_m=seeds.scale_m * n / n.norm(dim=1, keepdim=True))[changed]

    def after_step(self, ctx: SeedContext, stats: StepStats, memory: dict[str, Any]) -> Edit | None:
        """Remove what the frame sees through."""
        if not self.prunes or stats.stage != "online" or stats.step_in_frame != 1:
            return None
        voxel_m = 0.0 if ctx.volume is None else ctx.volume.config.voxel_size_m
        gone = in_front(ctx, max(0.015, 1.5 * voxel_m))
        return Edit(keep=~gone) if gone.any() else None


def similarity(a: Float[Tensor, "H W 3"], b: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Structural similarity around each pixel (Wang et al. 2004), mean over the channels: 1 where both are equal."""
    mean_a, mean_b = box_blur(a, SSIM_PX), box_blur(b, SSIM_PX)
    var_a, var_b = box_blur(a * a, SSIM_PX) - mean_a**2, box_blur(b * b, SSIM_PX) - mean_b**2
    both = box_blur(a * b, SSIM_PX) - mean_a * mean_b
    light = (2 * mean_a * mean_b + SSIM_C1) / (mean_a**2 + mean_b**2 + SSIM_C1)
    return (light * (2 * both + SSIM_C2) / (var_a + var_b + SSIM_C2)).mean(dim=-1)
