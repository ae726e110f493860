"""Counting in 64-bit words: a slab of 8 x 8 voxels is one word, bit 8 y + z."""

from llvmlite import ir
from numba import types
from numba.core.extending import intrinsic


@intrinsic
def popcount(typingctx, word):
    """Number of ones in a uint64, int64."""
    return types.int64(types.uint64), lambda context, builder, sig, args: builder.ctpop(args[0])


@intrinsic
def lowest(typingctx, word):
    """Position of the lowest one in a uint64 that is not zero, uint64."""

    def codegen(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), codegen
