"""Real spherical harmonics up to degree 3, one basis function at a time; constants as in the reference."""

# pyright: reportIndexIssue=false
# A return inside a chain of if and elif is decided when the kernel is compiled:
# ruff: noqa: RET505

import triton
import triton.language as tl

from gsfusion_nb.constants import SH_C0
from gsfusion_nb.geometry import spherical_harmonics as reference

_C0 = tl.constexpr(SH_C0)
_C1 = tl.constexpr(reference.C1)
_C20, _C21, _C22 = (tl.constexpr(c) for c in reference.C2)
_C30, _C31, _C32, _C33, _C34 = (tl.constexpr(c) for c in reference.C3)


@triton.jit
def harmonic(k: tl.constexpr, x, y, z):
    """Y_k at unit directions."""
    if k == 0:
        return _C0 + 0.0 * x
    elif k == 1:
        return -_C1 * y
    elif k == 2:
        return _C1 * z
    elif k == 3:
        return -_C1 * x
    elif k == 4:
        return _C20 * x * y
    elif k == 5:
        return -_C20 * y * z
    elif k == 6:
        return _C21 * (2 * z * z - x * x - y * y)
    elif k == 7:
        return -_C20 * x * z
    elif k == 8:
        return _C22 * (x * x - y * y)
    elif k == 9:
        return -_C30 * y * (3 * x * x - y * y)
    elif k == 10:
        return _C31 * x * y * z
    elif k == 11:
        return -_C32 * y * (4 * z * z - x * x - y * y)
    elif k == 12:
        return _C33 * z * (2 * z * z - 3 * x * x - 3 * y * y)
    elif k == 13:
        return -_C32 * x * (4 * z * z - x * x - y * y)
    elif k == 14:
        return _C34 * z * (x * x - y * y)
    else:
        return -_C30 * x * (x * x - 3 * y * y)


@triton.jit
def harmonic_gradient(k: tl.constexpr, x, y, z):
    """(d/dx, d/dy, d/dz) of the polynomial Y_k."""
    o = 0.0 * x
    if k == 0:
        return o, o, o
    elif k == 1:
        return o, o - _C1, o
    elif k == 2:
        return o, o, o + _C1
    elif k == 3:
        return o - _C1, o, o
    elif k == 4:
        return _C20 * y, _C20 * x, o
    elif k == 5:
        return o, -_C20 * z, -_C20 * y
    elif k == 6:
        return -2 * _C21 * x, -2 * _C21 * y, 4 * _C21 * z
    elif k == 7:
        return -_C20 * z, o, -_C20 * x
    elif k == 8:
        return 2 * _C22 * x, -2 * _C22 * y, o
    elif k == 9:
        return -6 * _C30 * x * y, -3 * _C30 * (x * x - y * y), o
    elif k == 10:
        return _C31 * y * z, _C31 * x * z, _C31 * x * y
    elif k == 11:
        return 2 * _C32 * x * y, -_C32 * (4 * z * z - x * x - 3 * y * y), -8 * _C32 * y * z
    elif k == 12:
        return -6 * _C33 * x * z, -6 * _C33 * y * z, 3 * _C33 * (2 * z * z - x * x - y * y)
    elif k == 13:
        return -_C32 * (4 * z * z - 3 * x * x - y * y), 2 * _C32 * x * y, -8 * _C32 * x * z
    elif k == 14:
        return 2 * _C34 * x * z, -2 * _C34 * y * z, _C34 * (x * x - y * y)
    else:
        return -3 * _C30 * (x * x - y * y), 6 * _C30 * x * y, o
