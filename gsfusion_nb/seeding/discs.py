"""Seeds as discs in the surface."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import quaternion
from ..types import Seeds
from .inputs import SeedInputs

LONGEST_STRETCH = 1.5
"""Largest factor by which a large disc is longer in the direction in which it leans."""
LARGE_PX = 10.0
"""Standard deviation in the picture from which on a disc is stretched, pixels. Smaller ones have
many neighbours, and overlap."""
LEAST_LEAN = 1e-3
"""Sine of the angle below which a disc faces the camera."""


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


def stretched(
    inputs: SeedInputs, seeds: Seeds, discs: Seeds, size_px: Float[Tensor, " N"]
) -> Seeds:
    """The discs, of which the large ones cover in the picture what their round Gaussians covered.

    A disc that leans by an angle a away from the camera is foreshortened by cos(a) in the direction
    in which it leans. There a disc of ``LARGE_PX`` or more is longer by 1 / cos(a), at most
    ``LONGEST_STRETCH``.

    Args:
        inputs: The frame, for its camera's position.
        seeds: Round Gaussians.
        discs: What ``as_discs`` made of them.
        size_px: Their standard deviations in the picture, pixels. [N]

    Differentiable: no. Source: ours; docs/gsfusion.md has what it changes.
    """
    normal = quaternion.to_matrix(discs.quat)[:, :, 2]
    to_camera = inputs.frame.T_WC[:3, 3] - seeds.xyz_W
    view = to_camera / to_camera.norm(dim=1, keepdim=True)
    cos = (normal * view).sum(dim=1, keepdim=True)
    lean = view - cos * normal
    sin = lean.norm(dim=1, keepdim=True)
    is_stretched = (size_px >= LARGE_PX) & (sin[:, 0] > LEAST_LEAN)
    along = lean / sin.clamp_min(LEAST_LEAN)
    across = torch.linalg.cross(normal, along)
    quat = quaternion.from_matrix(torch.stack([along, across, normal], dim=-1))
    scale_m = discs.scale_m.clone()
    scale_m[:, 0] /= cos[:, 0].abs().clamp_min(1 / LONGEST_STRETCH)
    return dataclasses.replace(
        discs,
        quat=torch.where(is_stretched[:, None], quat, discs.quat),
        scale_m=torch.where(is_stretched[:, None], scale_m, discs.scale_m),
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
