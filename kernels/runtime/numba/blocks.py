"""Which blocks of a volume are in view, found without a look at every block."""

import math

import numpy as np
from numba import njit, parallel_chunksize, prange

from gsfusion_nb.tsdf.block_pool import BLOCKS_IN_BOX
from gsfusion_nb.tsdf.volume import TsdfVolume
from gsfusion_nb.types import Camera

from ..arguments import lens_of


def blocks_in_view(
    volume: TsdfVolume, camera: Camera, T_CW: np.ndarray, end_m: float, more_m: float
) -> np.ndarray:
    """Rows of the blocks in view up to a depth: whose bounding sphere, larger by ``more_m``, meets
    it. int32"""
    in_view = np.zeros(volume.n_blocks, np.bool_)
    coords = volume.block_coords.numpy()
    side = volume.block_size_m
    radius = 0.5 * side * math.sqrt(3.0) + more_m
    size = (camera.height, camera.width)
    # blocks in view were mostly made together, so halves of all are not even
    with parallel_chunksize(16):
        _meet(
            coords,
            volume.pool.boxes(volume.n_blocks),
            T_CW,
            lens_of(camera),
            size,
            float(end_m),
            side,
            radius,
            in_view,
        )
    return np.flatnonzero(in_view).astype(np.int32)


@njit(parallel=True, cache=True, error_model="numpy")
def _meet(coords, boxes, T_CW, lens, size, end, side, radius, in_view):
    """Set ``in_view`` for the blocks whose sphere meets the view; those of a box are looked at only
    if its sphere does."""
    for box in prange(len(boxes)):
        low = boxes[box, 0]
        high = boxes[box, 1]
        x = 0.5 * (low[0] + high[0] + 1)
        y = 0.5 * (low[1] + high[1] + 1)
        z = 0.5 * (low[2] + high[2] + 1)
        dx = high[0] - low[0]
        dy = high[1] - low[1]
        dz = high[2] - low[2]
        reach = radius + 0.5 * side * math.sqrt(dx * dx + dy * dy + dz * dz)
        # for rounding
        if _meets_view(side * x, side * y, side * z, T_CW, lens, size, end, 1.001 * reach):
            for b in range(box * BLOCKS_IN_BOX, min(len(in_view), (box + 1) * BLOCKS_IN_BOX)):
                x = coords[b, 0] + 0.5
                y = coords[b, 1] + 0.5
                z = coords[b, 2] + 0.5
                in_view[b] = _meets_view(
                    side * x, side * y, side * z, T_CW, lens, size, end, radius
                )


@njit(cache=True, error_model="numpy")
def _meets_view(X, Y, Z, T_CW, lens, size, end, radius):
    """Whether a sphere meets the view up to a depth."""
    height, width = size
    fx = lens.fx
    fy = lens.fy
    cx = lens.cx
    cy = lens.cy
    z = T_CW[2, 0] * X + T_CW[2, 1] * Y + T_CW[2, 2] * Z + T_CW[2, 3]
    if z < -radius or z > end + radius:
        return False
    x = T_CW[0, 0] * X + T_CW[0, 1] * Y + T_CW[0, 2] * Z + T_CW[0, 3]
    y = T_CW[1, 0] * X + T_CW[1, 1] * Y + T_CW[1, 2] * Z + T_CW[1, 3]
    slope_u = math.sqrt(fx * fx + max(cx, width - cx) ** 2)
    slope_v = math.sqrt(fy * fy + max(cy, height - cy) ** 2)
    aside = min(fx * x + cx * z, (width - cx) * z - fx * x)
    margin_y = min(fy * y + cy * z, (height - cy) * z - fy * y)
    return aside >= -radius * slope_u and margin_y >= -radius * slope_v
