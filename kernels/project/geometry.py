"""Where a Gaussian is, seen from the camera: steps that projection and its gradient share in the numba kernels."""

import math

import numpy as np
from numba import njit

from .layout import (
    CENTRE_X,
    CENTRE_Y,
    CENTRE_Z,
    R00,
    R01,
    R02,
    R10,
    R11,
    R12,
    R20,
    R21,
    R22,
    T0,
    T1,
    T2,
)

f32 = np.float32
_ONE, _TWO = f32(1.0), f32(2.0)
_SMALL = f32(1e-12)


@njit(inline="always")
def camera_point(cam, X, Y, Z):
    """A point of the world in the camera frame."""
    x = cam[R00] * X + cam[R01] * Y + cam[R02] * Z + cam[T0]
    y = cam[R10] * X + cam[R11] * Y + cam[R12] * Z + cam[T1]
    z = cam[R20] * X + cam[R21] * Y + cam[R22] * Z + cam[T2]
    return x, y, z


@njit(inline="always")
def direction(cam, X, Y, Z):
    """Unit vector from the camera's centre to a point of the world, and 1 / its distance."""
    dx, dy, dz = X - cam[CENTRE_X], Y - cam[CENTRE_Y], Z - cam[CENTRE_Z]
    inv = _ONE / max(math.sqrt(dx * dx + dy * dy + dz * dz), _SMALL)
    return dx * inv, dy * inv, dz * inv, inv


@njit(inline="always")
def rotation(q):
    """|q| and the entries of R(q / |q|), row by row."""
    norm = max(math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), _SMALL)
    w, x, y, z = q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm
    return (
        norm,
        _ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y),
        _TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x),
        _TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y),
    )  # fmt: skip


@njit(inline="always")
def clamp(x, limit):
    """x, between -limit and limit."""
    return min(max(x, -limit), limit)
