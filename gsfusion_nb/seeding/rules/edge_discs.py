"""Our rules: discs in the surface that are long along the edges of the picture."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ...errors import ArgumentError
from ...geometry import quaternion, se3
from ...types import Camera, Seeds
from ..context import SeedContext
from ..image_features import box_blur, luma, structure_directions
from ..map_rule import MapRule
from ..rule import seeding_rule


@seeding_rule
def edge_discs(
    ctx: SeedContext,
    *,
    spacing_px: float = 4.0,
    radius: float = 0.7,
    stretch: float = 4.0,
    colour_window: float = 0.8,
    opacity: float = 0.9,
    thickness: float = 0.2,
    required_weight: float = 1.0,
    coverage: bool = True,
) -> Seeds:
    """Discs on a regular grid of pixels, in voxels observed for the first time, stretched along the
    picture's edges.

    Colour changes little along an edge, so a Gaussian that is long in this direction and narrow
    across it represents more of the picture than a round one. With the coherence c of the structure
    tensor (0 to 1) the two standard deviations in the surface are s sqrt(f) and s / sqrt(f), with f
    = 1 + (stretch - 1) c and s = z radius spacing_px / fx: the area stays the same.

    Args:
        ctx: Frame and volume.
        spacing_px: Distance between the Gaussians in a row, pixels; every second row is shifted by
            half of it. Larger:
            fewer and larger Gaussians.
        radius: s as a share of the spacing.
        stretch: How much longer than wide a Gaussian on a straight edge is; 1: round discs.
        colour_window: The colour is the mean over a square of this many spacings, so that a single
            pixel does not decide for the whole area; 0: the pixel's own.
        opacity: Peak opacity.
        thickness: Standard deviation along the normal, as a share of s.
        required_weight: Observation count that the voxel must have, as in the rule ``gsfusion``.
        coverage: False skips the voxel test; then every frame is seeded everywhere.

    Source: ours; docs/seeding_results.md has the comparison with the published rules.
    """
    if spacing_px < 1:
        raise ArgumentError(f"edge_discs: spacing_px must be at least 1, got {spacing_px}")
    if stretch < 1:
        raise ArgumentError(f"edge_discs: stretch must be at least 1, got {stretch}")
    uv = hexagonal_grid(ctx.camera, spacing_px).to(ctx.frame.depth_m)
    uv = uv[ctx.values_at(ctx.has_depth(), uv)]
    seeds = ctx.seeds_at(uv, radius * spacing_px, opacity=opacity)
    edge = structure_directions(luma(ctx.frame.rgb), odd(spacing_px))
    colours = box_blur(ctx.frame.rgb, odd(colour_window * spacing_px))
    f = 1 + (stretch - 1) * ctx.values_at(edge.coherence, uv)
    shape = torch.stack(
        [f.sqrt(), f.rsqrt(), torch.full_like(f, thickness)],
        dim=1,
    )
    seeds = dataclasses.replace(
        seeds,
        rgb=ctx.values_at(colours, uv).clamp(0, 1),
        scale_m=seeds.scale_m * shape,
        quat=quat_along(
            ctx.values_at(edge.direction, uv), ctx.values_at(ctx.normals(), uv), ctx.frame.T_WC
        ),
    )
    return seeds[ctx.voxel_weight(seeds.xyz_W) == required_weight] if coverage else seeds


def hexagonal_grid(camera: Camera, spacing_px: float) -> Float[Tensor, "N 2"]:
    """Positions in the image, each with six neighbours at about the same distance: rows sqrt(3) / 2
    spacings apart, every second one shifted by half a spacing. Continuous pixel coordinates. [N,
    2]"""
    v = torch.arange(
        min(spacing_px, camera.height) / 2,
        camera.height,
        spacing_px * 3**0.5 / 2,
    )
    u = torch.arange(min(spacing_px, camera.width) / 4, camera.width, spacing_px)
    shift = (torch.arange(len(v)) % 2) * (spacing_px / 2)
    grid = torch.stack(
        [u + shift[:, None], v[:, None].expand(-1, len(u))],
        dim=2,
    ).reshape(-1, 2)
    return grid[grid[:, 0] < camera.width]


def quat_along(
    edge: Float[Tensor, "N 2"],
    normal_C: Float[Tensor, "N 3"],
    T_WC: Float[Tensor, "4 4"],
) -> Float[Tensor, "N 4"]:
    """Orientation, wxyz, whose z axis is the normal and whose x axis is the direction in the
    surface that appears as ``edge`` in an image taken from straight ahead; where the normal is
    zero, the surface faces the camera."""
    facing = torch.zeros_like(normal_C)
    facing[:, 2] = -1.0
    z = torch.where(
        (normal_C != 0).any(dim=1, keepdim=True),
        normal_C,
        facing,
    )
    in_image = torch.cat([edge, torch.zeros_like(edge[:, :1])], dim=1)
    x = in_image - (in_image * z).sum(dim=1, keepdim=True) * z
    fallback = torch.linalg.cross(
        z,
        torch.stack([-edge[:, 1], edge[:, 0], torch.zeros_like(edge[:, 0])], dim=1),
    )
    # the surface is seen from the side
    x = torch.where(x.norm(dim=1, keepdim=True) > 1e-3, x, fallback)
    x = x / x.norm(dim=1, keepdim=True)
    axes = torch.stack([x, torch.linalg.cross(z, x), z], dim=2)
    return quaternion.from_matrix(se3.rotate(T_WC, axes.mT).mT)


def odd(window: float) -> int:
    """The odd whole number nearest to a length in pixels, at least 1."""
    return 2 * max(round((window - 1) / 2), 0) + 1


@seeding_rule
@dataclass(frozen=True, kw_only=True)
class edge_strokes(MapRule):
    """``edge_discs`` with learning rates of size and orientation that fit a map of few Gaussians.

    Adam moves a value by about its learning rate in a step. With the published 0.001 the size of a
    Gaussian that gets 50 steps changes by about 5 per cent. That is enough where a Gaussian covers
    a pixel or two, but not where it covers a few dozen. With 0.004 sizes and directions follow the
    picture. The rule needs a system with the settings ``optim.lr_log_scale`` and ``optim.lr_quat``,
    such as GSFusion.

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
        return edge_discs(ctx, **vars(self))
