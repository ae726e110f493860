"""Preparation of a depth frame for ICP: several sizes, with normals, without unusable pixels."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_shape
from ..geometry import depth_to_normals, pixel_grid, rays
from ..types import Camera

GRAZING_COSINE = 0.2
"""Surfaces at a more grazing angle (cosine below this, 78 degrees) are left out: their depth errors are largest, and
five times larger along the surface (released code of Peng et al. 2024)."""

BLOCK_JUMP = 0.05
"""Pixels of a block whose depth differs from the block's median by more than this share lie on another surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthLevel:
    """A depth image of reduced size."""

    factor: int
    """One pixel stands for ``factor`` x ``factor`` of the frame's."""
    camera: Camera
    depth_m: Float[Tensor, "H W"]
    """z-depth, metres; 0 where there is none, or where ICP does not use it."""
    normal_C: Float[Tensor, "H W 3"]
    """Unit normals that face the camera, camera frame; 0 where they are not known."""


def depth_pyramid(depth_m: Float[Tensor, "H W"], camera: Camera, factors: tuple[int, ...]) -> list[DepthLevel]:
    """Reduced images of a depth frame, one for each of ``factors`` (Peng et al. 2024, "Input pre-processing").

    Args:
        depth_m: z-depth, metres, 0 where there is none. [H, W]
        camera: Its intrinsics.
        factors: Reduction of each level; they need not divide the size.

    Differentiable: no.
    """
    check_shape("depth_m", depth_m, (camera.height, camera.width))
    depth_m = torch.where(torch.isfinite(depth_m) & (depth_m > 0), depth_m, 0.0)
    reduced = {1: depth_m}
    for factor in sorted(set(factors)):
        finer = max(f for f in reduced if factor % f == 0)  # reducing an already reduced image is faster
        reduced[factor] = reduce_depth(reduced[finer], factor // finer)
    return [_level(reduced[factor], reduced_camera(camera, factor), factor) for factor in factors]


def _level(depth_m: Tensor, camera: Camera, factor: int) -> DepthLevel:
    normal_C = depth_to_normals(camera, depth_m)
    ray = rays(camera, pixel_grid(camera, device=depth_m.device, dtype=depth_m.dtype))
    cosine = -(normal_C * ray).sum(-1) / ray.norm(dim=-1)
    usable = cosine >= GRAZING_COSINE
    return DepthLevel(
        factor=factor,
        camera=camera,
        depth_m=depth_m.where(usable, 0.0),
        normal_C=normal_C.where(usable[..., None], 0.0),
    )


def reduced_camera(camera: Camera, factor: int) -> Camera:
    """The camera with pixels ``factor`` times as large; the last ones may reach beyond the image."""
    return Camera(
        width=-(-camera.width // factor),
        height=-(-camera.height // factor),
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=camera.cx / factor,
        cy=camera.cy / factor,
    )


def reduce_depth(depth_m: Float[Tensor, "H W"], factor: int) -> Float[Tensor, "h w"]:
    """Harmonic mean of each block's pixels on the surface of its median; missing where less than half have depth.

    On a plane 1 / z is linear in the pixel, so this is the plane's depth at the block's centre. The noise of 1 / z of a
    stereo or structured-light camera is also the same at all depths. The maximum, which the released code uses, moves
    slanted surfaces back; a mean across a depth edge would be a point in mid-air.
    """
    if factor == 1:
        return depth_m
    H, W = depth_m.shape
    h, w = -(-H // factor), -(-W // factor)
    padded = torch.nn.functional.pad(depth_m, (0, w * factor - W, 0, h * factor - H))
    block = padded.view(h, factor, w, factor).transpose(1, 2).reshape(h, w, factor * factor)
    known = block > 0
    median = block.masked_fill(~known, float("nan")).nanmedian(-1, keepdim=True).values
    same = known & ((block - median).abs() <= BLOCK_JUMP * median)
    inverse = (1.0 / block.clamp_min(1e-6)).where(same, 0.0).sum(-1) / same.sum(-1).clamp_min(1)
    enough = 2 * known.sum(-1) >= factor * factor
    return (1.0 / inverse.clamp_min(1e-6)).where(enough, 0.0)
