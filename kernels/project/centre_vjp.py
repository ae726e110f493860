"""The gradient with respect to the centre of every splat in the image, for those who ask for it (numba)."""

import numpy as np
from numba import njit

from ..composite.sums import SUM_GX, SUM_GY
from .splat import CONIC_A, CONIC_B, CONIC_C


@njit(cache=True, error_model="numpy")
def centre_vjp(splats, start, trained, pair_sums, v_uv):
    """Write dL/d(u, v) to every row of ``v_uv`` [N, 2]; arguments as for ``vjp.project_rows_vjp``.

    ln alpha = ln o - (A dx^2 + C dy^2) / 2 - B dx dy with (dx, dy) = pixel - (u, v), so v_u = A sum g dx + B sum g dy.
    """
    all_trained = trained.shape[0] == 0
    for i in range(v_uv.shape[0]):
        g_x, g_y = np.float32(0.0), np.float32(0.0)
        v_uv[i] = g_x
        if start[i] == start[i + 1] or not (all_trained or trained[i]):
            continue
        for slot in range(start[i], start[i + 1]):
            g_x += pair_sums[slot, SUM_GX]
            g_y += pair_sums[slot, SUM_GY]
        s = splats[i]
        v_uv[i, 0] = s[CONIC_A] * g_x + s[CONIC_B] * g_y
        v_uv[i, 1] = s[CONIC_B] * g_x + s[CONIC_C] * g_y


@njit(cache=True, error_model="numpy")
def row_sums(start, trained, abs_sums, v_uv_abs):
    """Write the sum of |dL/d(u, v)| over the pixels to every row of ``v_uv_abs`` [N, 2]; ``abs_sums``: over those of
    each tile, from ``composite_backward``."""
    all_trained = trained.shape[0] == 0
    for i in range(v_uv_abs.shape[0]):
        u, v = np.float32(0.0), np.float32(0.0)
        if all_trained or trained[i]:
            for slot in range(start[i], start[i + 1]):
                u += abs_sums[slot, 0]
                v += abs_sums[slot, 1]
        v_uv_abs[i, 0], v_uv_abs[i, 1] = u, v
