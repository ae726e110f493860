"""Seeds as discs in the surface."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import quaternion
from ..types import Seeds
from .inputs import SeedInputs
from .quadtree import Cells

LONGEST = 1.5
"""Largest standard deviation of a disc, in those of its cell's round Gaussian."""
LARGE_LEVEL = 3
"""Deepest level of the quadtree whose discs are as large as their cells on the surface. A cell of
this level is an eighth of the picture wide. Smaller ones have many neighbours, and overlap."""
LEAST_COSINE = 1e-3
"""Cosine of the angle between normal and ray below which a surface counts as seen from its edge."""


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


def over_cells(inputs: SeedInputs, discs: Seeds, cells: Cells) -> Seeds:
    """The discs, of which the large ones cover their cells in the picture.

    A disc that leans away from the camera is foreshortened, and a cell is not square. So where the
    quadtree cut at most ``LARGE_LEVEL`` times, a disc is as large as its cell on the plane
    (``cell_on_plane``), and at most ``LONGEST`` times as large as the round Gaussian.

    Args:
        inputs: The frame, for its camera and pose.
        discs: What ``as_discs`` made of the round Gaussians of ``cells``. [L]
        cells: Leaves of the quadtree. [L]

    Differentiable: no. Source: ours; docs/gsfusion.md has what it changes.
    """
    rows = (cells.level <= LARGE_LEVEL).nonzero()[:, 0]
    normal = quaternion.to_matrix(discs.quat[rows])[:, :, 2]
    longest, size_m = cell_on_plane(inputs, discs.xyz_W[rows], normal, cells[rows])
    axes = torch.stack([longest, torch.linalg.cross(normal, longest), normal], dim=-1)
    quat = discs.quat.clone()
    quat[rows] = quaternion.from_matrix(axes)
    scale_m = discs.scale_m.clone()
    scale_m[rows, :2] = torch.minimum(size_m, LONGEST * scale_m[rows, :2])
    return dataclasses.replace(discs, quat=quat, scale_m=scale_m)


def cell_on_plane(
    inputs: SeedInputs,
    xyz_W: Float[Tensor, "M 3"],
    normal_W: Float[Tensor, "M 3"],
    cells: Cells,
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 2"]]:
    """What each cell covers on the plane through its Gaussian.

    The ray of the pixel (u, v) is r = ((u - cx) / fx, (v - cy) / fy, 1). It meets the plane with
    the normal n through the point at depth z in

        X(u, v) = z (n . r_0) / (n . r) r,     dX/du = z (dr/du - r (n . dr/du) / (n . r)),

    and the same for v. In the picture a cell has the standard deviations w / sqrt(2) and h /
    sqrt(2), so that a square one has half its diagonal, the size of Eq. 10. On the plane, those of

        M = [dX/du w / sqrt(2),  dX/dv h / sqrt(2)]

    are its singular values.

    Args:
        inputs: The frame, for its camera and pose.
        xyz_W: Points in the middle of the cells, metres, world frame. [M, 3]
        normal_W: Unit normals there, world frame. [M, 3]
        cells: The cells. [M]

    Returns:
        longest [M, 3], the unit vector on the plane in which a cell is longest, world frame; and
        size_m [M, 2], the standard deviations along it and across, metres.

    Differentiable: no.
    """
    camera = inputs.camera
    right, down, forward = inputs.frame.T_WC[:3, :3].unbind(dim=1)
    to_point = xyz_W - inputs.frame.T_WC[:3, 3]
    z = (to_point @ forward)[:, None]
    ray = to_point / z
    cos = (normal_W * ray).sum(dim=1, keepdim=True)
    cos = torch.where(cos < 0, -1.0, 1.0) * cos.abs().clamp_min(LEAST_COSINE)

    def on_plane(
        ray_step: Float[Tensor, " 3"], size_px: Float[Tensor, " M"]
    ) -> Float[Tensor, "M 3"]:
        along_ray = (normal_W @ ray_step)[:, None] / cos
        return z * size_px[:, None] * (ray_step - ray * along_ray)

    a = on_plane(right / camera.fx, cells.width / 2**0.5)
    b = on_plane(down / camera.fy, cells.height / 2**0.5)
    # M = [a, b] has the right singular vectors (cos t, sin t) and (-sin t, cos t)
    angle = 0.5 * torch.atan2(2 * (a * b).sum(dim=1), (a * a).sum(dim=1) - (b * b).sum(dim=1))
    cos_t = angle.cos()[:, None]
    sin_t = angle.sin()[:, None]
    longest = cos_t * a + sin_t * b
    across = cos_t * b - sin_t * a
    size_m = torch.stack([longest.norm(dim=1), across.norm(dim=1)], dim=-1)
    return longest / size_m[:, :1], size_m


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
