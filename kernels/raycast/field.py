"""Where rays look D up: in a copy that tells what has been observed, or in the map with its W.

The march is compiled for each: with one for both that branches at every look-up, rays take 10 to 20 % longer.
"""

# Intrinsics are called without their typing context, which pyright cannot follow:
# pyright: reportCallIssue=false

from typing import NamedTuple

import numpy as np
from numba import types
from numba.core.extending import overload

from ..runtime.numba.simd import select, splat
from ..runtime.numba.simd_int import gather

_ZERO, _INFINITE = np.float32(0.0), np.float32(np.inf)


class Marked(NamedTuple):
    """D of every voxel that rays may look up, infinite where it has not been observed."""

    D: np.ndarray


class Unmarked(NamedTuple):
    """D and W of every voxel."""

    D: np.ndarray
    W: np.ndarray


def values(field, at, wanted):
    """D of sixteen voxels, infinite where they are not wanted or have not been observed; in compiled code only."""
    raise NotImplementedError


@overload(values, inline="always")
def _(field, at, wanted):
    if not isinstance(field, types.NamedTuple | types.NamedUniTuple):
        return None
    if field.instance_class is Marked:
        return lambda field, at, wanted: gather(field.D, at, wanted, splat(_INFINITE))

    def asking(field, at, wanted):
        observed = gather(field.W, at, wanted, splat(_ZERO)) > splat(_ZERO)
        return select(observed, gather(field.D, at, wanted, splat(_INFINITE)), splat(_INFINITE))

    return asking
