"""A slab of 8 x 8 voxels as one word, bit 8 y + z: its neighbours, its cubes and their corners."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
from numba import int64, njit, uint64

from ..runtime.numba import shared_cache as shared_cache  # before the functions are made
from .layout import SIGN, SIGN_Y, SIGN_YZ, SIGN_Z, X, Y, Z

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
