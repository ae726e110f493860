"""Projection and colour of every Gaussian, and their gradient: ``project.cu``."""

import torch
from torch import Tensor

from gsfusion_nb.types import Camera, GaussianParams

from ..runtime.cuda.launch import launch, packed, parts
from .lens import lens

SPLAT = 12
"""u, v, conic A, B, C, ln(opacity), r, g, b, depth, half extents x, y of the ellipse alpha >= 1/255; of gradients the
moments that ``composite.cu`` names."""

_BLOCK = 128
_NAMES = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")


def project_rows(params: GaussianParams, camera: Camera, T_WC: Tensor) -> tuple[Tensor, Tensor]:
    """Splats [N, SPLAT], written only for rows that are drawn, and depths [N], infinite for the others."""
    N, device = len(params), T_WC.device
    splats = torch.empty(N, SPLAT, dtype=torch.float32, device=device)
    depth = torch.empty(N, dtype=torch.float32, device=device)
    launch(
        "render_forward", f"project:project_{_coefficients(params)}", parts(N, _BLOCK), _BLOCK, *_arrays(params), T_WC,
        splats, depth, N, *lens(camera), camera.width, camera.height,
    )  # fmt: skip
    return splats, depth


def project_rows_vjp(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    splats: Tensor,
    depth: Tensor,
    moments: Tensor,
    rows: Tensor | None,
) -> GaussianParams:
    """Gradients of the parameters from the moments [N, SPLAT]; zero where ``rows`` [N] is false."""
    N, arrays = len(params), _arrays(params)
    out = [torch.empty_like(a) for a in arrays]
    launch(
        "render_vjp", f"project:project_vjp_{_coefficients(params)}", parts(N, _BLOCK), _BLOCK, *arrays, T_WC, splats,
        depth, moments, rows, *out, N, *lens(camera),
    )  # fmt: skip
    return GaussianParams(**dict(zip(_NAMES, out, strict=True)))


def _arrays(params: GaussianParams) -> list[Tensor]:
    return [packed(getattr(params, name)) for name in _NAMES]


def _coefficients(params: GaussianParams) -> int:
    K = params.sh.shape[1]
    if K not in (1, 4, 9, 16):
        raise ValueError(f"sh must be [N, K, 3] with K = 1, 4, 9 or 16 (degree 0 to 3), got {list(params.sh.shape)}")
    return K
