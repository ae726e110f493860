"""Small functions of numba kernels: tasks dealt out in turn to threads, twists."""

from collections.abc import Callable

import numpy as np
from numba import njit

GROUPS = 16


def kernel_part(function: Callable) -> Callable:
    """A function that is compiled once, and whose machine code is then part of each kernel that
    calls it.

    ``inline="always"`` copies its statements into the caller instead. There numba works on them
    four times, and again at each call: with it, kernels of many parts take twice as long to
    compile.
    """
    return njit(function, error_model="numpy", forceinline=True)


@njit(inline="always")
def cyclic_size(n):
    """Numbers that the loop runs through for ``n`` tasks: ``n`` rounded up to whole rounds."""
    return (n + GROUPS - 1) // GROUPS * GROUPS


@njit(inline="always")
def cyclic_task(k, n):
    """The task of number ``k`` of the loop; numbers from ``n`` on stand for no task."""
    rounds = (n + GROUPS - 1) // GROUPS
    return k % rounds * GROUPS + k // rounds


SMALL = 1e-4
"""Below this square of the angle the series are used, as in ``gsfusion_nb.geometry.se3.exp``."""


@njit(cache=True, error_model="numpy")
def solve_into(H, b, x):
    """Write the solution of H x = b to ``x``: Cholesky, H symmetric and positive definite; H is
    overwritten."""
    n = b.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = H[i, j]
            for k in range(j):
                total -= H[i, k] * H[j, k]
            H[i, j] = np.sqrt(total) if i == j else total / H[j, j]
        total = b[i]
        for k in range(i):
            total -= H[i, k] * x[k]
        x[i] = total / H[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= H[k, i] * x[k]
        x[i] = total / H[i, i]


@njit(cache=True, error_model="numpy")
def turn_about_camera(T, xi):
    """Replace the pose T [3, 4] by that after a twist about its camera along the world's axes,
    translation first."""
    a = xi[3]
    b = xi[4]
    c = xi[5]
    t2 = a * a + b * b + c * c
    if t2 < SMALL:
        A = 1.0 - t2 / 6.0 + t2 * t2 / 120.0
        B = 0.5 - t2 / 24.0 + t2 * t2 / 720.0
        C = 1.0 / 6.0 - t2 / 120.0
        C += t2 * t2 / 5040.0
    else:
        t = np.sqrt(t2)
        A = np.sin(t) / t
        B = (1.0 - np.cos(t)) / t2
        C = (t - np.sin(t)) / (t2 * t)
    for k in range(3):  # R v = v + A w x v + B w x (w x v)
        x = T[0, k]
        y = T[1, k]
        z = T[2, k]
        p = b * z - c * y
        q = c * x - a * z
        r = a * y - b * x
        T[0, k] = x + A * p + B * (b * r - c * q)
        T[1, k] = y + A * q + B * (c * p - a * r)
        T[2, k] = z + A * r + B * (a * q - b * p)
    x = xi[0]
    y = xi[1]
    z = xi[2]
    p = b * z - c * y
    q = c * x - a * z
    r = a * y - b * x
    T[0, 3] += x + B * p + C * (b * r - c * q)
    T[1, 3] += y + B * q + C * (c * p - a * r)
    T[2, 3] += z + B * r + C * (a * q - b * p)
