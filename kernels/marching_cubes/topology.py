"""Which cubes and which of their edges make a surface: only signs and observed voxels matter, 64 to a word.

A slab of 8 x 8 voxels as one word, bit 8 y + z: its neighbours, its cubes and their corners.
"""

import numpy as np
from numba import int64, njit, prange, uint64

from gsfusion_nb.tsdf.block_pool import VOXELS_PER_BLOCK

from ..runtime.numba import shared_cache as shared_cache  # before the functions are made
from ..runtime.numba.scalars import lowest, popcount
from .layout import SIGN, SIGN_Y, SIGN_YZ, SIGN_Z, WORDS, X, Y, Z

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false


NONE = np.uint64(0)
_LAST_Z, _FIRST_Z = np.uint64(0x8080808080808080), np.uint64(0x0101010101010101)


@njit(cache=True, error_model="numpy")
def next_y(words, b, x, upper):
    """The word of the voxels one step further along y."""
    row = upper[Y, b]
    across = words[row, x] << uint64(56) if row >= 0 else NONE
    return words[b, x] >> uint64(8) | across


@njit(cache=True, error_model="numpy")
def next_z(words, b, x, upper):
    """The same along z; and so on for the other directions."""
    row = upper[Z, b]
    across = (words[row, x] & _FIRST_Z) << uint64(7) if row >= 0 else NONE
    return (words[b, x] & ~_FIRST_Z) >> uint64(1) | across


@njit(cache=True, error_model="numpy")
def next_x(words, b, x, upper):
    if x < 7:
        return words[b, x + 1]
    row = upper[X, b]
    return words[row, 0] if row >= 0 else NONE


@njit(cache=True, error_model="numpy")
def previous_y(words, b, x, lower):
    row = lower[Y, b]
    across = words[row, x] >> uint64(56) if row >= 0 else NONE
    return words[b, x] << uint64(8) | across


@njit(cache=True, error_model="numpy")
def previous_z(words, b, x, lower):
    row = lower[Z, b]
    across = (words[row, x] & _LAST_Z) >> uint64(7) if row >= 0 else NONE
    return (words[b, x] & ~_LAST_Z) << uint64(1) | across


@njit(cache=True, error_model="numpy")
def previous_x(words, b, x, lower):
    if x > 0:
        return words[b, x - 1]
    row = lower[X, b]
    return words[row, 7] if row >= 0 else NONE


@njit(cache=True, error_model="numpy")
def corner_words(words, b, x, upper):
    """Sign words of the eight corners x + 2 y + 4 z of the cubes of a slab."""
    return (
        words[SIGN, b, x],
        next_x(words[SIGN], b, x, upper),
        words[SIGN_Y, b, x],
        next_x(words[SIGN_Y], b, x, upper),
        words[SIGN_Z, b, x],
        next_x(words[SIGN_Z], b, x, upper),
        words[SIGN_YZ, b, x],
        next_x(words[SIGN_YZ], b, x, upper),
    )


@njit(cache=True, error_model="numpy")
def case_of(corners, bit):
    case = NONE
    for c in range(8):
        case |= (corners[c] >> bit & uint64(1)) << uint64(c)
    return int64(case)


@njit(cache=True, error_model="numpy")
def same_sign(c):
    """Cubes whose eight corners, words as ``corner_words`` gives them, all have the same sign."""
    some = c[0] | c[1] | c[2] | c[3] | c[4] | c[5] | c[6] | c[7]
    every = c[0] & c[1] & c[2] & c[3] & c[4] & c[5] & c[6] & c[7]
    return every | ~some


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
