"""The running averages of sixteen voxels: distance, and colour with its weight (Eq. 7 to 9)."""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

import numpy as np
from numba import int32, njit

from gsfusion_nb.tsdf.block_pool import VOXELS_PER_BLOCK
from gsfusion_nb.tsdf.voxel_update import (
    INT16_ONE,
    LEAST_COLOUR_WEIGHT,
    LITTLE_COLOUR,
    NEAREST_COLOUR_M,
)

from ..runtime.numba.simd import (
    absolute,
    first_byte,
    gather,
    load,
    maximum,
    minimum,
    second_byte,
    select,
    splat,
    splat_int,
    store,
    third_byte,
    times,
)

f32 = np.float32
_ZERO = f32(0.0)
_ONE = f32(1.0)
_GREY_LEVELS = f32(255.0)
_LEAST = f32(LEAST_COLOUR_WEIGHT)
_LITTLE = f32(LITTLE_COLOUR)
_MOST_BY_DISTANCE = f32(NEAREST_COLOUR_M**-2)


MEAN, EQ9, INT16 = range(3)
AVERAGES = {"mean": MEAN, "eq9": EQ9, "int16": INT16}
_INT16_ONE = f32(INT16_ONE)
_INT16_ULP = f32(1.0 / INT16_ONE)
_ULP_IS_ONE = f32(2.0**23)
"""From here on float32 numbers are whole: adding and subtracting it rounds a smaller positive
number."""


@njit(cache=True, error_model="numpy")
def as_published(D, d, W, W_k, average):
    """Averages "eq9" and "int16" of ``tsdf_update``."""
    if average == EQ9:
        return (D * W + d * W_k) / (W + W_k)
    unit = splat(_INT16_ONE)
    one = splat(_ONE)
    total = _rounded(D * unit) * (W_k - one) + _truncated(d * unit)
    return _truncated(total / W_k) * splat(_INT16_ULP)


@njit(cache=True, error_model="numpy")
def _rounded(x):
    """The whole numbers next to lanes of less than 2^22 in size."""
    shift = splat(_ULP_IS_ONE * f32(1.5))
    return (x + shift) - shift


@njit(cache=True, error_model="numpy")
def _truncated(x):
    """Lanes of less than 2^22 in size, rounded towards zero."""
    zero = splat(_ZERO)
    one = splat(_ONE)
    whole = _rounded(x)
    whole = select((x > zero) & (whole > x), whole - one, whole)
    return select((x < zero) & (whole < x), whole + one, whole)


@njit(inline="always")
def average_bytes(C, at, step, colour):
    """Move the colours of sixteen voxels by ``step`` towards 8-bit ones; ``at``: where those of the
    block begin."""
    grey_level = splat(_ONE / _GREY_LEVELS)
    green_at = at + VOXELS_PER_BLOCK
    blue_at = at + 2 * VOXELS_PER_BLOCK
    store(C, at, load(C, at) + step * (first_byte(colour) * grey_level - load(C, at)))
    store(
        C,
        green_at,
        load(C, green_at) + step * (second_byte(colour) * grey_level - load(C, green_at)),
    )
    store(
        C, blue_at, load(C, blue_at) + step * (third_byte(colour) * grey_level - load(C, blue_at))
    )


@njit(inline="always")
def average_floats(C, at, step, rgb, pixel, observed):
    """The same towards the colours of pixels in a float32 image."""
    zero = splat(_ZERO)
    green_at = at + VOXELS_PER_BLOCK
    blue_at = at + 2 * VOXELS_PER_BLOCK
    red = pixel * splat_int(int32(3))
    green = red + splat_int(int32(1))
    blue = red + splat_int(int32(2))
    store(C, at, load(C, at) + step * (gather(rgb, red, observed, zero) - load(C, at)))
    store(
        C,
        green_at,
        load(C, green_at) + step * (gather(rgb, green, observed, zero) - load(C, green_at)),
    )
    store(
        C, blue_at, load(C, blue_at) + step * (gather(rgb, blue, observed, zero) - load(C, blue_at))
    )


@njit(inline="always")
def colour_weight_of(sdf, inv_z, W_rgb, inv_band, by_distance, falling):
    """See ``gsfusion_nb.tsdf.integrate.colour_weight``; ``inv_band``: 0 for no band."""
    w = splat(_ONE)
    if by_distance:
        w = minimum(inv_z * inv_z, splat(_MOST_BY_DISTANCE))
    ramp = splat(_ONE) - absolute(sdf) * inv_band
    share = maximum(ramp, splat(_ZERO))
    if not falling:
        share = select(ramp >= splat(_ZERO), splat(_ONE), splat(_ZERO))
    w = w * share
    return select(splat(_LITTLE) > W_rgb, maximum(w, splat(_LEAST)), w)


@njit(inline="always")
def update(D, W, at, sdf, observed, inv_truncation, most, average):
    """The running average of sixteen voxels, Eq. 7 to 9. Returns the share of the new value."""
    zero = splat(_ZERO)
    one = splat(_ONE)
    W_old = load(W, at)
    D_old = load(D, at)
    W_new = select(observed, minimum(W_old + one, most), W_old)  # Eq. 8
    step = select(observed, one / W_new, zero)
    d = maximum(minimum(times(sdf, inv_truncation), one), zero - one)  # Eq. 7
    store(W, at, W_new)
    if average == MEAN:
        store(D, at, D_old + select(observed, step * (d - D_old), zero))
    else:
        store(D, at, select(observed, as_published(D_old, d, W_old, W_new, average), D_old))
    return step


@njit(inline="always")
def update_colour_weight(W_rgb, at, w, most):
    """Add the weights ``w`` to those of sixteen colours. Returns the share of the new colours."""
    W_old = load(W_rgb, at)
    W_new = minimum(W_old + w, most)
    store(W_rgb, at, W_new)
    return select(
        w > splat(_ZERO), minimum(w / maximum(W_new, splat(_LEAST)), splat(_ONE)), splat(_ZERO)
    )
