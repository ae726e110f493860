"""New Gaussians as discs in the surface, in place of balls."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ..types import Seeds
from .context import SeedContext


def as_discs(ctx: SeedContext, seeds: Seeds, normal_W: Float[Tensor, "N 3"], thickness: float) -> Seeds:
    """The same seeds, thin along their normals: standard deviations (s, s, thickness s), the z axis along the normal.

    Args:
        ctx: The frame, for its camera's position.
        seeds: Round Gaussians.
        normal_W: Normals, world frame; where one is zero, the disc faces the camera. [N, 3]
        thickness: Smallest standard deviation as a share of the others. Flat Gaussians (2DGS) have no third one; the
            renderer here needs one.
    """
    to_camera = ctx.frame.T_WC[:3, 3] - seeds.xyz_W
    axis = torch.where((normal_W != 0).any(dim=1, keepdim=True), normal_W, to_camera)
    return dataclasses.replace(seeds, quat=ctx.quat_from_normals(axis), scale_m=thin(seeds.scale_m, thickness))


def thin(scale_m: Float[Tensor, "N 3"], thickness: float) -> Float[Tensor, "N 3"]:
    """Standard deviations of which the third is multiplied by ``thickness``."""
    return scale_m * scale_m.new_tensor([1.0, 1.0, thickness])
