"""Real spherical harmonics up to degree 3 at one direction, and their gradient; constants as in the
reference."""

import numpy as np
from numba import njit

from gsfusion_nb.geometry import spherical_harmonics as reference
from gsfusion_nb.geometry.spherical_harmonics import SH_C0

from ..runtime.numba import shared_cache as shared_cache  # before the functions are made

f32 = np.float32
_C0 = f32(SH_C0)
_C1 = f32(reference.C1)
_C20, _C21, _C22 = (f32(c) for c in reference.C2)
_C30, _C31, _C32, _C33, _C34 = (f32(c) for c in reference.C3)
_2 = f32(2)
_3 = f32(3)
_4 = f32(4)
_6 = f32(6)
_8 = f32(8)


@njit(cache=True, error_model="numpy")
def basis_into(x, y, z, K, Y):
    """Write the first K = 1, 4, 9 or 16 basis functions at the unit direction (x, y, z) to
    ``Y``."""
    Y[0] = _C0
    if K < 4:
        return
    Y[1] = -_C1 * y
    Y[2] = _C1 * z
    Y[3] = -_C1 * x
    if K < 9:
        return
    xx = x * x
    yy = y * y
    zz = z * z
    Y[4] = _C20 * x * y
    Y[5] = -_C20 * y * z
    Y[6] = _C21 * (_2 * zz - xx - yy)
    Y[7] = -_C20 * x * z
    Y[8] = _C22 * (xx - yy)
    if K < 16:
        return
    Y[9] = -_C30 * y * (_3 * xx - yy)
    Y[10] = _C31 * x * y * z
    Y[11] = -_C32 * y * (_4 * zz - xx - yy)
    Y[12] = _C33 * z * (_2 * zz - _3 * xx - _3 * yy)
    Y[13] = -_C32 * x * (_4 * zz - xx - yy)
    Y[14] = _C34 * z * (xx - yy)
    Y[15] = -_C30 * x * (xx - _3 * yy)


@njit(cache=True, error_model="numpy")
def gradient_into(x, y, z, K, w):
    """sum_k w_k grad Y_k as (d/dx, d/dy, d/dz) of the polynomials; K = 4, 9 or 16."""
    vx = -_C1 * w[3]
    vy = -_C1 * w[1]
    vz = _C1 * w[2]
    if K < 9:
        return vx, vy, vz
    a = _C20 * w[4]
    b = _C20 * w[5]
    c = _2 * _C21 * w[6]
    d = _C20 * w[7]
    e = _2 * _C22 * w[8]
    vx += a * y - c * x - d * z + e * x
    vy += a * x - b * z - c * y - e * y
    vz += -b * y + _2 * c * z - d * x
    if K < 16:
        return vx, vy, vz
    xx = x * x
    yy = y * y
    zz = z * z
    xy = x * y
    yz = y * z
    xz = x * z
    a = _C30 * w[9]
    b = _C31 * w[10]
    c = _C32 * w[11]
    d = _3 * _C33 * w[12]
    e = _C32 * w[13]
    f = _C34 * w[14]
    g = _C30 * w[15]
    vx += (
        -_6 * a * xy
        + b * yz
        + _2 * c * xy
        - _2 * d * xz
        - e * (_4 * zz - _3 * xx - yy)
        + _2 * f * xz
    )
    vx += -_3 * g * (xx - yy)
    vy += (
        -_3 * a * (xx - yy)
        + b * xz
        - c * (_4 * zz - xx - _3 * yy)
        - _2 * d * yz
        + _2 * e * xy
        - _2 * f * yz
    )
    vy += _6 * g * xy
    vz += b * xy - _8 * c * yz + d * (_2 * zz - xx - yy) - _8 * e * xz + f * (xx - yy)
    return vx, vy, vz
