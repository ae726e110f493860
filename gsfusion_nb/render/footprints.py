"""Which Gaussians a camera sees, and how large they are in its image."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import op
from ..operands import check_gaussians, check_view
from ..types import Camera, GaussianParams
from .in_view import rows_in_view
from .project import project_gaussians


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprints:
    """Every Gaussian as a camera sees it, whether something hides it or not."""

    visible: Bool[Tensor, " N"]
    """Whether the box outside which its alpha is below 1/255 reaches into the image."""
    radius_px: Float[Tensor, " N"]
    """Half of the longer side of that box, pixels; 0 where not visible."""


def check_footprints(params: Any, camera: Any, T_WC: Any) -> None:
    """Raise ``ValueError`` for arguments that ``footprints`` refuses."""
    check_gaussians(params)
    check_view(camera, T_WC, params.xyz_W.device)


@op("footprints", check_footprints)
@torch.no_grad()
def footprints(params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Footprints:
    """Visibility and size in the image of every Gaussian.

    Args:
        params, camera, T_WC: as given to ``render``.

    Differentiable: no.
    Source: Kerbl et al. 2023, section 6; the size of the box is that of ``project_gaussians``, which depends on the
    opacity.
    """
    rows = rows_in_view(params, camera, T_WC).nonzero()[:, 0]
    p = project_gaussians(params[rows], camera, T_WC)
    image_size = p.uv.new_tensor([camera.width, camera.height])
    inside = ((p.uv + p.extent_px > 0) & (p.uv - p.extent_px < image_size)).all(1)
    visible = p.visible & inside & params.sh[rows].isfinite().all(2).all(1)
    every = torch.zeros(len(params), dtype=torch.bool, device=rows.device)
    radius_px = p.extent_px.new_zeros(len(params))
    every[rows] = visible
    radius_px[rows] = torch.where(visible, p.extent_px.amax(1), 0.0)
    return Footprints(visible=every, radius_px=radius_px)
