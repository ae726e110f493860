"""The blending of a few pixels, one Gaussian at a time.

The renderer does not record which Gaussians contributed to a pixel. Here every Gaussian is
evaluated at the chosen pixels, with the formulas of ``render.composite`` but without the lists of
the tiles: a Gaussian that is missing in a list is seen here.
"""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...errors import ArgumentError
from ...geometry.spherical_harmonics import sh_to_rgb
from ...render import Projection, blend_rows, project_gaussians
from ...render.composite import pixel_offsets, splat_alpha
from ...types import Camera, GaussianParams


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """A Gaussian map as a camera sees it, before blending: ellipses and colours."""

    projection: Projection
    rgb: Float[Tensor, "N 3"]
    camera: Camera


def project_splats(params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Splats:
    """The first two stages of ``render``: EWA projection and the colour seen from this camera."""
    T_WC = T_WC.to(params.xyz_W)
    return Splats(
        projection=project_gaussians(params, camera, T_WC),
        rgb=sh_to_rgb(params.sh, params.xyz_W, T_WC[:3, 3]),
        camera=camera,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Blend:
    """The terms of ``C = sum_k w_k c_k`` at P pixels. Column k is one Gaussian, nearest first."""

    row: Int[Tensor, " K"]
    """Row in the map."""
    offset_px: Float[Tensor, "P K 2"]
    """(dx, dy) = pixel centre - (u, v)."""
    alpha: Float[Tensor, "P K"]
    """Zero where below 1/255 and where blending had already stopped."""
    transmittance: Float[Tensor, "P K+1"]
    """T_k in front of each; the last column is the transmittance behind all."""

    @property
    def weight(self) -> Float[Tensor, "P K"]:
        """w_k = alpha_k T_k."""
        return self.alpha * self.transmittance[:, :-1]


def blend_at(splats: Splats, uv: Float[Tensor, "P 2"]) -> Blend:
    """Blend every Gaussian that reaches one of the pixel centres ``uv`` (Kerbl et al. 2023, eq.
    2-3).

    Args:
        splats: Ellipses and colours.
        uv: Pixel centres (i + 0.5, j + 0.5), pixels. [P, 2]

    Differentiable: no.
    """
    p = splats.projection
    low = uv.amin(0) - p.extent_px
    high = uv.amax(0) + p.extent_px
    reaches = p.visible & (p.uv >= low).all(1) & (p.uv <= high).all(1)
    row = reaches.nonzero().squeeze(1)
    row = row[p.depth_m[row].argsort(stable=True)]
    x, y = uv.floor().long().unbind(-1)
    alpha, _, weight = blend_rows(
        p.uv[row],
        p.conic[row],
        p.opacity[row],
        x,
        y,
    )
    alpha = torch.where(weight > 0, alpha, 0.0).T
    one = alpha.new_ones(len(uv), 1)
    T = torch.cat([one, (1.0 - alpha).cumprod(1)], dim=1)
    used = (alpha > 0).any(0)
    return Blend(
        row=row[used],
        offset_px=(uv[:, None] - p.uv[row])[:, used],
        alpha=alpha[:, used],
        transmittance=torch.cat([T[:, :-1][:, used], T[:, -1:]], dim=1),
    )


def reaching(
    splats: Splats,
    u: int,
    v: int,
) -> tuple[Int[Tensor, " K"], Float[Tensor, " K"]]:
    """Rows of the Gaussians that reach the centre of pixel (u, v), in the order of the map, and
    their alpha there.

    Raises:
        ValueError: the pixel is not in the picture.
    """
    check_pixel(splats.camera, u, v)
    p = splats.projection
    row = (
        (p.visible & ((p.uv - p.uv.new_tensor([u + 0.5, v + 0.5])).abs() <= p.extent_px).all(1))
        .nonzero()
        .squeeze(1)
    )
    dx, dy = pixel_offsets(
        p.uv[row],
        torch.tensor([u]),
        torch.tensor([v]),
    )
    alpha = splat_alpha(
        dx,
        dy,
        p.conic[row],
        p.opacity[row],
    )[:, 0]
    return row[alpha > 0], alpha[alpha > 0]


def check_pixel(camera: Camera, u: int, v: int) -> None:
    """Raise ``ValueError`` unless the picture has pixel (u, v)."""
    if not (0 <= u < camera.width and 0 <= v < camera.height):
        raise ArgumentError(
            f"pixel ({u}, {v}) is outside the picture: columns 0..{camera.width - 1}, rows "
            f"0..{camera.height - 1}"
        )


def camera_of_pixel(camera: Camera, u: int, v: int) -> Camera:
    """The camera whose whole picture is pixel (u, v) of ``camera``."""
    return dataclasses.replace(
        camera,
        width=1,
        height=1,
        cx=camera.cx - u,
        cy=camera.cy - v,
    )
