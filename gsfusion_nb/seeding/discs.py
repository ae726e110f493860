"""Seeds as discs in the surface."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import quaternion
from ..types import Seeds
from .inputs import SeedInputs


def as_discs(
    inputs: SeedInputs, seeds: Seeds, normal_W: Float[Tensor, "N 3"], thickness: float
) -> Seeds:
    """The same seeds, thin along their normals: standard deviations (s, s, thickness s), the z axis
    along the normal.

    Args:
        inputs: The frame, for its camera's position.
        seeds: Round Gaussians.
        normal_W: Normals, world frame; where one is zero, the disc faces the camera. [N, 3]
        thickness: Smallest standard deviation as a share of the others. Flat Gaussians (2DGS) have
            no third one; the renderer here needs one.
    """
    to_camera = inputs.frame.T_WC[:3, 3] - seeds.xyz_W
    axis = torch.where(
        (normal_W != 0).any(dim=1, keepdim=True),
        normal_W,
        to_camera,
    )
    return dataclasses.replace(
        seeds, quat=quat_from_normals(axis), scale_m=thin(seeds.scale_m, thickness)
    )


def thin(scale_m: Float[Tensor, "N 3"], thickness: float) -> Float[Tensor, "N 3"]:
    """Standard deviations of which the third is multiplied by ``thickness``."""
    return scale_m * scale_m.new_tensor([1.0, 1.0, thickness])


def quat_from_normals(normal: Float[Tensor, "M 3"]) -> Float[Tensor, "M 4"]:
    """Unit quaternions, wxyz, that turn the z axis to the normals by the smaller angle; a disc is
    then thin along z. A normal need not have unit length; a zero one gives the identity. [M, 4]"""
    length = normal.norm(dim=1, keepdim=True)
    z = torch.zeros_like(normal)
    z[:, 2] = 1.0
    return quaternion.shortest_arc(z, torch.where(length > 0, normal / length, z))
