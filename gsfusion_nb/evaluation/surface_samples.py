"""Points spread evenly over a surface: a mesh, or a map of discs."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..errors import ArgumentError
from ..geometry import quaternion
from ..types import GaussianParams, Mesh
from .triangles import face_areas, face_corners


def sample_surface(
    mesh: Mesh, n: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    """``n`` points spread evenly over the area of ``mesh``, float64, and the triangles that they
    lie on.

    A triangle is drawn with probability area / total area; inside it the point (1 - r) a + r ((1 -
    s) b + s c) with r = sqrt(u1), s = u2 is uniform.

    Raises:
        ValueError: if the mesh has no area.

    Differentiable: no.
    """
    area_sums = face_areas(mesh).cumsum(0)
    if len(area_sums) == 0 or not area_sums[-1] > 0:
        raise ArgumentError(
            f"a mesh to sample must have area, got {len(area_sums)} faces of total area 0"
        )
    return samples_by_area(mesh, area_sums, n, generator)


def samples_by_area(
    mesh: Mesh, area_sums: Float[Tensor, " F"], n: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    """As ``sample_surface``; ``area_sums``: running sums of the areas of the faces."""
    face, draw = draw_by_area(area_sums, n, generator)
    r = draw[:, 1:2].sqrt()
    s = draw[:, 2:3]
    a, b, c = face_corners(mesh, face).unbind(1)
    return (1 - r) * a + r * ((1 - s) * b + s * c), face


def sample_discs(
    params: GaussianParams, n: int, generator: torch.Generator
) -> Float[Tensor, "n 3"]:
    """``n`` points spread evenly over the opaque discs, each with a radius of one standard
    deviation.

    A disc is drawn with probability a b / sum, its two largest standard deviations; inside it
    sqrt(u) makes the radius uniform over the area. Source: Peng et al. 2024, section 3.1 (the
    surfel's extent); the released evaluation takes the same number of points on every disc instead.
    """
    opaque = params[params.opacity_logit > 0]
    if not len(opaque):
        return params.xyz_W.new_zeros(0, 3).double()
    scale, axis = opaque.log_scale.double().exp().sort(dim=1, descending=True)
    area_sums = (scale[:, 0] * scale[:, 1]).cumsum(0)
    row, draw = draw_by_area(area_sums, n, generator)
    r = draw[:, 1].sqrt()
    angle = 2 * torch.pi * draw[:, 2]
    R = quaternion.to_matrix(opaque.quat.double())[row]
    a, b = (R.gather(2, axis[row, k, None, None].expand(-1, 3, 1)).squeeze(2) for k in (0, 1))
    along_a = scale[row, 0] * r * angle.cos()
    along_b = scale[row, 1] * r * angle.sin()
    return opaque.xyz_W.double()[row] + along_a[:, None] * a + along_b[:, None] * b


def draw_by_area(
    area_sums: Float[Tensor, " N"], n: int, generator: torch.Generator
) -> tuple[Int[Tensor, " n"], Float[Tensor, "n 3"]]:
    """``n`` rows drawn in proportion to their areas, of which ``area_sums`` are the running
    sums, and the numbers in 0..1 that were drawn for each: the first chose the row, the other two
    are free."""
    draw = torch.rand(
        n,
        3,
        generator=generator,
        dtype=torch.float64,
        device=generator.device,
    ).to(area_sums.device)
    return torch.searchsorted(
        area_sums,
        draw[:, 0] * area_sums[-1],
        right=True,
    ).clamp(max=len(area_sums) - 1), draw
