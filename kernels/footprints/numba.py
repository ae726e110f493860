"""Visibility and size in the image of every Gaussian, in one pass over the rows; float64 goes to
the reference."""

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from gsfusion_nb.render.constants import ALPHA_MIN, NEAR_PLANE_M
from gsfusion_nb.render.on_screen import Footprints
from gsfusion_nb.types import Camera, GaussianParams

from ..project.layout import (
    DEPTH,
    EXTENT_U,
    EXTENT_V,
    HEIGHT,
    LN_OPACITY,
    NEAR,
    SPLAT,
    WIDTH,
    U,
    V,
    arrays_of,
    pack_camera,
)
from ..project.numba import CHUNK, _project, camera_point
from ..runtime.numba.launch import launching

f32 = np.float32
_ALPHA_MIN = f32(ALPHA_MIN)
_ONE = f32(1.0)
_ZERO = f32(0.0)


def footprints(
    params: GaussianParams, camera: Camera, T_WC: Tensor, near_m: float = NEAR_PLANE_M
) -> Footprints:
    """See ``gsfusion_nb.render.on_screen``."""
    radius_px = torch.empty(len(params), dtype=torch.float32)
    with launching():
        _radii(arrays_of(params), pack_camera(camera, T_WC, near_m), radius_px.numpy())
    return Footprints(visible=radius_px > 0, radius_px=radius_px)


@njit(parallel=True, cache=True, error_model="numpy")
def _radii(params, cam, radius):
    """Write half of the longer side of the box of each row, 0 where it does not reach into the
    image."""
    xyz = params.xyz
    log_scale = params.log_scale
    quat = params.quat
    logit = params.logit
    sh = params.sh
    N = sh.shape[0]
    for part in prange((N + CHUNK - 1) // CHUNK):
        s = np.empty(SPLAT, np.float32)
        for i in range(part * CHUNK, min(N, part * CHUNK + CHUNK)):
            radius[i] = _ZERO
            x, y, z = camera_point(cam, xyz[i, 0], xyz[i, 1], xyz[i, 2])
            opacity = _ONE / (_ONE + math.exp(-logit[i]))
            if not (z > cam[NEAR] and opacity >= _ALPHA_MIN):
                continue
            s[DEPTH] = z
            s[LN_OPACITY] = math.log(opacity)
            if not _project(cam, x, y, z, log_scale[i], quat[i], s):
                continue
            in_columns = s[U] + s[EXTENT_U] > _ZERO and s[U] - s[EXTENT_U] < cam[WIDTH]
            if (
                in_columns
                and s[V] + s[EXTENT_V] > _ZERO
                and s[V] - s[EXTENT_V] < cam[HEIGHT]
                and np.isfinite(sh[i]).all()
            ):
                radius[i] = max(s[EXTENT_U], s[EXTENT_V])
