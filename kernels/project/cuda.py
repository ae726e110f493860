"""Projection and colour of every Gaussian, and their gradient: ``project.cu``."""

import math
from typing import Any

import torch
from torch import Tensor

from gsfusion_nb.render.constants import NEAR_PLANE_M
from gsfusion_nb.types import Camera, GaussianParams

from ..composite.layout import SUM_GX, SUM_GXX, SUM_GXY, SUM_GY, SUM_GYY
from ..runtime.arguments import as_bytes, packed, parts
from ..runtime.cuda.launch import launch
from .layout import CONIC_A, CONIC_B, CONIC_C, SPLAT, projection_lens

_BLOCK = 128


def project_rows(
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    near_m: float = NEAR_PLANE_M,
    far_m: float = math.inf,
) -> tuple[Tensor, Tensor]:
    """Splats [N, SPLAT], written only for rows that are drawn, and depths [N], infinite for the
    others."""
    N = len(params)
    device = T_WC.device
    splats = torch.empty(N, SPLAT, dtype=torch.float32, device=device)
    depth = torch.empty(N, dtype=torch.float32, device=device)
    given = (_arrays(params) | {"pose": T_WC}, projection_lens(camera, near_m, far_m))
    size = (camera.width, camera.height)
    kernel = f"project:project_{params.sh.shape[1]}"
    launch("render_forward", kernel, parts(N, _BLOCK), _BLOCK, *given, splats, depth, N, *size)
    return splats, depth


def gradients_of(
    operation: str,
    kernel: str,
    saved: Any,
    *given: dict[str, Any],
    rows: Tensor | None,
    v_uv: Tensor | None,
    v_uv_abs: Tensor | None,
    v_conic: Tensor | None = None,
) -> GaussianParams:
    """dL/d of the parameters of a drawn map; also fills dL/d of the centres and conics in the image
    if asked to.

    Args:
        operation: Named by errors.
        kernel: Adds up the gradients of the splats over their pixels; another, with ``_abs`` behind
            its name, adds up the absolute values of those of the centres, too.
        saved: The record of the picture, whose ``work`` the kernel is given.
        given: Further structs for it, the last one with dL/d of the picture.
        rows, v_uv, v_uv_abs, v_conic: As for ``render_vjp``.
    """
    params = saved.params
    splats = saved.splats
    depth = saved.depth
    trained = as_bytes(rows)
    N = len(params)
    arrays = _arrays(params)
    device = splats.device
    sums = torch.zeros(N, SPLAT, dtype=torch.float32, device=device)
    tiles = saved.lists.n_tiles
    if v_uv_abs is None:
        launch(operation, kernel, tiles, _BLOCK, saved.work, *given, trained, sums)
    else:
        abs_sums = torch.zeros(N, 2, dtype=torch.float32, device=device)
        launch(
            operation, f"{kernel}_abs", tiles, _BLOCK, saved.work, *given, trained, sums, abs_sums
        )
        v_uv_abs.copy_(abs_sums)
    drawn = depth.isfinite() if rows is None else depth.isfinite() & rows
    if v_uv is not None:
        A, B, C = (splats[:, column] for column in (CONIC_A, CONIC_B, CONIC_C))
        g_x = sums[:, SUM_GX]
        g_y = sums[:, SUM_GY]
        v_uv.copy_(
            torch.where(
                drawn[:, None], torch.stack([A * g_x + B * g_y, B * g_x + C * g_y], dim=1), 0.0
            )
        )
    if v_conic is not None:
        # ln alpha = ln o - (A dx^2 + C dy^2) / 2 - B dx dy
        g = sums[:, [SUM_GXX, SUM_GXY, SUM_GYY]]
        v_conic.copy_(torch.where(drawn[:, None], g * g.new_tensor([-0.5, -1.0, -0.5]), 0.0))
    out = {name: torch.empty_like(array) for name, array in arrays.items()}
    view = (arrays | {"pose": saved.T_WC}, projection_lens(saved.camera))
    blocks = parts(N, _BLOCK)
    kernel = f"project:project_vjp_{params.sh.shape[1]}"
    launch(operation, kernel, blocks, _BLOCK, *view, splats, depth, sums, trained, out, N)
    return GaussianParams(**out)


def _arrays(params: GaussianParams) -> dict[str, Tensor]:
    return {name: packed(column) for name, column in vars(params).items()}
