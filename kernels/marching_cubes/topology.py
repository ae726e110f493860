"""Which cubes and which of their edges make a surface: only signs and observed voxels matter, 64 to a word."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
from numba import int64, njit, prange, uint64

from gsfusion_nb.constants import VOXELS_PER_BLOCK

from ..runtime.numba.bits import lowest, popcount
from .layout import SIGN, SIGN_Y, SIGN_YZ, SIGN_Z, WORDS, X, Y, Z
from .slabs import (
    NONE,
    case_of,
    corner_words,
    next_x,
    next_y,
    next_z,
    previous_x,
    previous_y,
    previous_z,
    same_sign,
)

f32 = np.float32


@njit(parallel=True, cache=True, error_model="numpy")
def sign_words(voxels, min_weight, negative, seen):
    """One bit per voxel, a word per slab of a block [B, 8]: whether D is negative, whether it was observed enough."""
    D, W = voxels.D, voxels.W
    for task in prange(negative.shape[0]):
        b = int64(task)
        for x in range(8):
            minus, known = NONE, NONE
            for n in range(64):
                at = b * VOXELS_PER_BLOCK + 64 * x + n
                minus |= uint64(D[at] < f32(0)) << uint64(n)
                known |= uint64((W[at] >= min_weight) & (W[at] > f32(0))) << uint64(n)
            negative[b, x], seen[b, x] = minus, known


@njit(cache=True, error_model="numpy")
def find_topology(negative, seen, upper, lower, count):
    """The parts of a ``Topology``."""
    B = negative.shape[0]
    words = np.empty((WORDS, B, 8), np.uint64)
    minus, minus_y, minus_z, minus_yz = negative, words[SIGN_Y], words[SIGN_Z], words[SIGN_YZ]
    seen_z, seen_yz, whole = np.empty((B, 8), np.uint64), np.empty((B, 8), np.uint64), np.empty((B, 8), np.uint64)
    for b in range(B):
        for x in range(8):
            minus_y[b, x], minus_z[b, x] = next_y(minus, b, x, upper), next_z(minus, b, x, upper)
            words[SIGN, b, x] = negative[b, x]
            seen_z[b, x] = seen[b, x] & next_z(seen, b, x, upper)
    for b in range(B):
        for x in range(8):
            minus_yz[b, x] = next_y(minus_z, b, x, upper)
            seen_yz[b, x] = seen_z[b, x] & next_y(seen_z, b, x, upper)
    for b in range(B):
        for x in range(8):
            whole[b, x] = seen_yz[b, x] & next_x(seen_yz, b, x, upper)
    # An edge has a vertex if its ends differ in sign and one of the four cubes around it is whole.
    whole_y, whole_z = seen_yz, seen_z
    for b in range(B):
        for x in range(8):
            whole_y[b, x] = whole[b, x] | previous_y(whole, b, x, lower)
            whole_z[b, x] = whole[b, x] | previous_z(whole, b, x, lower)
    active = np.empty((B, 8), np.uint64)
    starts, first_triangle = np.zeros(8 * B + 1, np.int64), np.zeros(B + 1, np.int64)
    for b in range(B):
        triangles = 0
        for x in range(8):
            m = minus[b, x]
            words[X, b, x] = (m ^ next_x(minus, b, x, upper)) & (whole_z[b, x] | previous_y(whole_z, b, x, lower))
            words[Y, b, x] = (m ^ minus_y[b, x]) & (whole_z[b, x] | previous_x(whole_z, b, x, lower))
            words[Z, b, x] = (m ^ minus_z[b, x]) & (whole_y[b, x] | previous_x(whole_y, b, x, lower))
            n = popcount(words[X, b, x]) + popcount(words[Y, b, x]) + popcount(words[Z, b, x])
            starts[8 * b + x + 1] = starts[8 * b + x] + n
            corners = corner_words(words, b, x, upper)
            cubes = whole[b, x] & ~same_sign(corners)
            active[b, x] = cubes
            while cubes != NONE:
                triangles += count[case_of(corners, lowest(cubes))]
                cubes &= cubes - uint64(1)
        first_triangle[b + 1] = first_triangle[b] + triangles
    return words, active, starts, first_triangle
