"""Projection and colour of every Gaussian, and their gradient: ``project.cu``."""

import torch
from torch import Tensor

from gsfusion_nb.types import Camera, GaussianParams

from ..composite.layout import SUM_GX, SUM_GY
from ..runtime.arguments import packed, parts
from ..runtime.cuda.launch import launch
from .layout import CONIC_A, CONIC_B, CONIC_C, SPLAT, projection_lens

_BLOCK = 128


def project_rows(params: GaussianParams, camera: Camera, T_WC: Tensor) -> tuple[Tensor, Tensor]:
    """Splats [N, SPLAT], written only for rows that are drawn, and depths [N], infinite for the others."""
    N, device = len(params), T_WC.device
    splats = torch.empty(N, SPLAT, dtype=torch.float32, device=device)
    depth = torch.empty(N, dtype=torch.float32, device=device)
    given, size = (_arrays(params) | {"pose": T_WC}, projection_lens(camera)._asdict()), (camera.width, camera.height)
    kernel = f"project:project_{_coefficients(params)}"
    launch("render_forward", kernel, parts(N, _BLOCK), _BLOCK, *given, splats, depth, N, *size)
    return splats, depth


def project_rows_vjp(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    splats: Tensor,
    depth: Tensor,
    sums: Tensor,
    trained: Tensor | None,
) -> GaussianParams:
    """Gradients of the parameters from the sums of ``composite.cu`` [N, SPLAT]; zero where ``trained`` [N] is 0."""
    N, arrays = len(params), _arrays(params)
    out = {name: torch.empty_like(array) for name, array in arrays.items()}
    given, blocks = (arrays | {"pose": T_WC}, projection_lens(camera)._asdict()), parts(N, _BLOCK)
    kernel = f"project:project_vjp_{_coefficients(params)}"
    launch("render_vjp", kernel, blocks, _BLOCK, *given, splats, depth, sums, trained, out, N)
    return GaussianParams(**out)


def centre_vjp(splats: Tensor, depth: Tensor, sums: Tensor, rows: Tensor | None, v_uv: Tensor) -> None:
    """Write dL/d of the centres in the image, from the sums of ``composite.cu``; zero for rows that are not drawn."""
    A, B, C = (splats[:, column] for column in (CONIC_A, CONIC_B, CONIC_C))
    g_x, g_y = sums[:, SUM_GX], sums[:, SUM_GY]
    drawn = depth.isfinite() if rows is None else depth.isfinite() & rows
    v_uv.copy_(torch.where(drawn[:, None], torch.stack([A * g_x + B * g_y, B * g_x + C * g_y], dim=1), 0.0))


def _arrays(params: GaussianParams) -> dict[str, Tensor]:
    return {name: packed(column) for name, column in vars(params).items()}


def _coefficients(params: GaussianParams) -> int:
    K = params.sh.shape[1]
    if K not in (1, 4, 9, 16):
        raise ValueError(f"sh must be [N, K, 3] with K = 1, 4, 9 or 16 (degree 0 to 3), got {list(params.sh.shape)}")
    return K
