"""Depth as another camera would have measured it."""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..geometry import depth_to_points, project, se3
from ..types import Camera

TIE = 1e-3
"""Nearest-pixel maps are shifted by this many pixels, so that of two equally near pixels the lower
one is always chosen."""

LARGEST_FOOTPRINT_PX = 64
"""A pixel of depth that would cover more pixels of the other camera across, because it is almost in
that camera's image plane, is a point."""

SAME_SURFACE = 0.05
"""Depths that differ by less than this share of the nearer one may be of one surface within a
pixel."""

SEAM_PX = 0.25
"""Slanted surfaces come apart between two pixels of depth, by less than this in the other image. A
seam is filled from both sides."""


def warp_depth(
    depth_m: Float[Tensor, "H W"],
    source: Camera,
    target: Camera,
    T_target_source: Float[Tensor, "4 4"],
) -> Float[Tensor, "h w"]:
    """Depth as ``target`` sees it: every point is moved to its pixel there; if several meet, the
    nearest is kept.

    One source pixel fills one target pixel, as it is right for two views of one camera. A target of
    a higher resolution would have holes (``register_depth``).

    Args:
        depth_m: z-depth, metres, 0 = missing. [H, W]
        source: Camera of ``depth_m``.
        target: Camera to warp into.
        T_target_source: Rigid transform from the source camera's frame to the target camera's.

    Returns:
        z-depth in the target camera, metres, 0 = missing. [h, w]

    Differentiable: no.
    """
    points = depth_to_points(source, depth_m)[depth_m > 0]
    P = se3.apply(T_target_source.to(depth_m.dtype), points)
    P = P[P[:, 2] > 0]
    u, v = project(target, P).floor().long().unbind(1)
    in_width = (u >= 0) & (u < target.width)
    in_height = (v >= 0) & (v < target.height)
    is_inside = in_width & in_height
    place = (v * target.width + u)[is_inside]
    nearest = depth_m.new_full((target.height * target.width,), torch.inf)
    nearest.scatter_reduce_(0, place, P[is_inside, 2], reduce="amin")
    nearest = nearest.where(nearest.isfinite(), torch.zeros_like(nearest))
    return nearest.reshape(target.height, target.width)


def register_depth(
    depth_m: Float[Tensor, "H W"],
    source: Camera,
    target: Camera,
    T_target_source: Float[Tensor, "4 4"],
) -> Float[Tensor, "h w"]:
    """Depth as a camera of another resolution sees it, without the holes that single points would
    leave.

    Every pixel of depth is a small plane parallel to its image. It fills the pixels of ``target``
    whose centres its outline covers there, and the one that its own centre falls into. Where
    several meet, the nearest surface is kept, and of it the pixel whose centre is nearest. Pixels
    that are left in a seam take one of the outlines beside it. So a lower resolution of depth gives
    blocks, and no depth is interpolated. librealsense fills outlines, too, when it aligns depth to
    colour.

    Args:
        depth_m: z-depth, metres, 0 = missing. [H, W]
        source: Camera of ``depth_m``.
        target: Camera to register to.
        T_target_source: Rigid transform from the source camera's frame to the target camera's.

    Returns:
        z-depth in the target camera, metres, 0 = missing. [h, w]

    Differentiable: no.
    """
    T = T_target_source.to(depth_m.dtype)
    has_depth = depth_m > 0
    P = se3.apply(T, depth_to_points(source, depth_m)[has_depth])
    half_width_m = 0.5 * depth_m[has_depth] / source.fx
    half_height_m = 0.5 * depth_m[has_depth] / source.fy
    half_right = T[:3, 0] * half_width_m[:, None]
    half_down = T[:3, 1] * half_height_m[:, None]
    in_front = P[:, 2] > 0
    P = P[in_front]
    half_right = half_right[in_front]
    half_down = half_down[in_front]
    outline = _Outline(
        uv=project(target, P),
        right=project(target, P + half_right) - project(target, P - half_right),
        down=project(target, P + half_down) - project(target, P - half_down),
        is_point=P[:, 2] <= half_right[:, 2].abs() + half_down[:, 2].abs(),
    )
    pairs = outline.covered(target)
    z = P[pairs.rows, 2]
    own = (~pairs.is_seam).nonzero()[:, 0]
    front_m = _front(
        pairs.place[own],
        z[own],
        pairs.away_px[own],
        target,
    )
    seam = pairs.is_seam.nonzero()[:, 0]
    seam = seam[front_m.flatten()[pairs.place[seam]] == 0]
    return torch.maximum(
        front_m,
        _front(pairs.place[seam], z[seam], pairs.away_px[seam], target),
    )


def _front(
    place: Int[Tensor, " K"],
    z: Float[Tensor, " K"],
    away_px: Float[Tensor, " K"],
    camera: Camera,
) -> Float[Tensor, "h w"]:
    """Of the depths ``z`` at each pixel, numbered row by row, one of the nearest surface; 0 where
    there is none.

    Of several on that surface the one is taken whose centre is nearest to that of the pixel: the
    nearest one of all would draw slanted surfaces towards the camera.
    """
    empty = z.new_full((camera.height * camera.width,), torch.inf)
    nearest = empty.scatter_reduce(0, place, z, reduce="amin")
    away_px = away_px.where(z <= (1 + SAME_SURFACE) * nearest[place], torch.inf)
    central = empty.scatter_reduce(0, place, away_px, reduce="amin")
    front = empty.scatter_reduce(
        0, place, z.where(away_px == central[place], torch.inf), reduce="amin"
    )
    return front.where(front.isfinite(), 0).reshape(camera.height, camera.width)


@dataclass(frozen=True, eq=False)
class _Covered:
    """Pairs of an outline and a pixel."""

    rows: Int[Tensor, " K"]
    """Of the outlines."""
    place: Int[Tensor, " K"]
    """The pixels, numbered row by row."""
    away_px: Float[Tensor, " K"]
    """Distance of their centres."""
    is_seam: Bool[Tensor, " K"]
    """The pixel is beside the outline."""


@dataclass(frozen=True, eq=False)
class _Outline:
    """Pixels of one camera as parallelograms in the image of another."""

    uv: Float[Tensor, "N 2"]
    """Their centres there."""
    right: Float[Tensor, "N 2"]
    down: Float[Tensor, "N 2"]
    """Their sides there."""
    is_point: Bool[Tensor, " N"]
    """They are so near that the sides are unknown."""

    def covered(self, camera: Camera) -> "_Covered":
        """Every pair of an outline and a pixel of ``camera``, the other one, that it covers or
        misses by less than a seam."""
        pixel = self.uv.floor()
        reach = 0.5 * (self.right.abs() + self.down.abs()) + SEAM_PX
        is_outline = ~self.is_point & (reach <= LARGEST_FOOTPRINT_PX / 2).all(dim=1)
        reach = reach * is_outline[:, None]
        area = 0.5 * _cross(self.right, self.down).abs()
        lengths = torch.stack([self.down.norm(dim=1), self.right.norm(dim=1)])
        farthest = (0, 0)
        if len(pixel):
            farthest = torch.ceil(reach - 0.5).clamp(min=0).amax(dim=0).long().tolist()
        offsets_x, offsets_y = (range(-n, n + 1) for n in farthest)
        pieces = []
        for du, dv in itertools.product(offsets_x, offsets_y):
            is_own = (du, dv) == (0, 0)
            place_px = pixel + pixel.new_tensor([du, dv])
            offset_px = place_px + 0.5 - self.uv
            over_sides = torch.stack(
                [_cross(offset_px, self.down).abs(), _cross(self.right, offset_px).abs()]
            )
            beyond = over_sides - area
            within_seam = (beyond <= SEAM_PX * lengths).all(dim=0)
            within_reach = (offset_px.abs() <= reach).all(dim=1)
            is_near = torch.ones_like(within_seam) if is_own else within_seam & within_reach
            is_near &= (place_px >= 0).all(dim=1)
            is_near &= (place_px < place_px.new_tensor([camera.width, camera.height])).all(dim=1)
            rows = is_near.nonzero()[:, 0]
            is_outside = (beyond[:, rows] > TIE * lengths[:, rows]).any(dim=0)
            is_seam = torch.zeros_like(is_outside) if is_own else is_outside
            u, v = place_px[rows].long().unbind(dim=1)
            place = v * camera.width + u
            away_px = offset_px[rows].norm(dim=1)
            pieces.append((rows, place, away_px, is_seam))
        return _Covered(*(torch.cat(parts) for parts in zip(*pieces, strict=True)))


def _cross(
    a: Float[Tensor, "N 2"],
    b: Float[Tensor, "N 2"],
) -> Float[Tensor, " N"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
