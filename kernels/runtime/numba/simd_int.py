"""Sixteen int32 lanes beside the float ones of ``simd``: indices, lookups through them, and marks in a byte map.

``i32x16`` is an LLVM ``<16 x i32>``. Bounds are the caller's everywhere; a lookup reads no lane that its mask excludes.
The lookups need opaque pointers, that is numba 0.62 (llvmlite 0.45) or later.
"""

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.extending import intrinsic, register_model

from .simd import LANES, f32x16, lane_overload, mask16

_INT = ir.IntType(32)
_FLOAT = ir.FloatType()
_INTS = ir.VectorType(_INT, LANES)
_FLOATS = ir.VectorType(_FLOAT, LANES)
_BYTE = ir.IntType(8)
_MASK = ir.VectorType(ir.IntType(1), LANES)


class _I32x16(types.Type):
    def __init__(self):
        super().__init__(name="i32x16")


i32x16 = _I32x16()


@register_model(_I32x16)
class _IntVectorModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _INTS)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [ir.Constant(_FLOAT, value)] * LANES)


def _lane(i: int) -> ir.Constant:
    return ir.Constant(_INT, i)


@intrinsic
def splat_int(typingctx, scalar):
    """All lanes equal to an int32."""

    def codegen(context, builder, sig, args):
        one = builder.insert_element(ir.Constant(_INTS, ir.Undefined), args[0], _lane(0))
        return builder.shuffle_vector(one, ir.Constant(_INTS, ir.Undefined), ir.Constant(_INTS, [_lane(0)] * LANES))

    return i32x16(types.int32), codegen


@intrinsic
def truncate(typingctx, vector):
    """Lanes rounded towards zero, as integers; the values must fit."""
    return i32x16(vector), lambda context, builder, sig, args: builder.fptosi(args[0], _INTS)


def _binary(emit, result=i32x16):
    @intrinsic
    def operation(typingctx, a, b):
        return result(a, b), lambda context, builder, sig, args: emit(builder, *args)

    return operation


lane_overload(operator.add, _binary(lambda b, x, y: b.add(x, y)), i32x16)
lane_overload(operator.sub, _binary(lambda b, x, y: b.sub(x, y)), i32x16)
lane_overload(operator.mul, _binary(lambda b, x, y: b.mul(x, y)), i32x16)


lane_overload(operator.and_, _binary(lambda b, x, y: b.and_(x, y)), i32x16)
lane_overload(operator.rshift, _binary(lambda b, x, y: b.ashr(x, y)), i32x16)
lane_overload(operator.eq, _binary(lambda b, x, y: b.icmp_signed("==", x, y), mask16), i32x16)
lane_overload(operator.ge, _binary(lambda b, x, y: b.icmp_signed(">=", x, y), mask16), i32x16)
below = _binary(lambda b, x, y: b.icmp_unsigned("<", x, y), mask16)
"""``0 <= x < y`` for a y that is not negative."""


@intrinsic
def but_not(typingctx, a, b):
    """``a`` and not ``b``, two masks."""
    return mask16(a, b), lambda context, builder, sig, args: builder.and_(args[0], builder.not_(args[1]))


@intrinsic
def select_int(typingctx, mask, a, b):
    """Lane of ``a`` where the mask is true, else of ``b``."""
    return i32x16(mask, a, b), lambda context, builder, sig, args: builder.select(*args)


def _element(context, builder, array_type, array, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [builder.sext(index, ir.IntType(64))], inbounds=True)


def _gather(scalar, vector, suffix, result):
    @intrinsic
    def operation(typingctx, array, index, mask, otherwise):
        sig = result(array, i32x16, mask16, result)

        def codegen(context, builder, sig, args):
            data = context.make_array(sig.args[0])(context, builder, args[0]).data
            pointers = ir.VectorType(ir.PointerType(), LANES)
            at = builder.gep(data, [args[1]], inbounds=True, source_etype=scalar)
            at.type = pointers
            kind = ir.FunctionType(vector, [pointers, _INT, _MASK, vector])
            name = f"llvm.masked.gather.v{LANES}{suffix}.v{LANES}p0"
            function = cgutils.get_or_insert_function(builder.module, kind, name)
            return builder.call(function, [at, _lane(4), args[2], args[3]])

        return sig, codegen

    return operation


gather = _gather(_FLOAT, _FLOATS, "f32", f32x16)
"""``gather(array, index, mask, otherwise)``: ``array[index]`` where the mask is true; a flat float32 array."""

gather_int = _gather(_INT, _INTS, "i32", i32x16)
"""The same for a flat int32 array."""


@intrinsic
def gather_pairs(typingctx, array, index, mask, otherwise):
    """Both halves of ``array[index]`` of a contiguous uint64 array: low 32 bits as float lanes, high 32 as int lanes.

    Where the mask is false: ``otherwise`` and 0. One lookup of 64 bits costs as much as one of 32.
    """
    sig = types.Tuple((f32x16, i32x16))(array, i32x16, mask16, f32x16)

    def codegen(context, builder, sig, args):
        wide = ir.IntType(64)
        wides, pointers = ir.VectorType(wide, LANES), ir.VectorType(ir.PointerType(), LANES)
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        at = builder.gep(data, [args[1]], inbounds=True, source_etype=wide)
        at.type = pointers
        kind = ir.FunctionType(wides, [pointers, _INT, _MASK, wides])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.gather.v{LANES}i64.v{LANES}p0")
        fallback = builder.zext(builder.bitcast(args[3], _INTS), wides)
        pair = builder.call(function, [at, ir.Constant(_INT, 8), args[2], fallback])
        low = builder.bitcast(builder.trunc(pair, _INTS), _FLOATS)
        high = builder.trunc(builder.lshr(pair, ir.Constant(wides, [ir.Constant(wide, 32)] * LANES)), _INTS)
        return context.make_tuple(builder, sig.return_type, (low, high))

    return sig, codegen


def _byte(shift):
    @intrinsic
    def operation(typingctx, vector):
        def codegen(context, builder, sig, args):
            shifted = builder.lshr(args[0], ir.Constant(_INTS, [_lane(shift)] * LANES))
            masked = builder.and_(shifted, ir.Constant(_INTS, [_lane(255)] * LANES))
            return builder.sitofp(masked, _FLOATS)

        return f32x16(vector), codegen

    return operation


first_byte, second_byte, third_byte = _byte(0), _byte(8), _byte(16)
"""The lowest, second and third byte of every lane, as float lanes."""


def _shuffle(builder, a, b, picks):
    order = ir.Constant(ir.VectorType(_INT, len(picks)), [_lane(i) for i in picks])
    return builder.shuffle_vector(a, b, order)


@intrinsic
def byte_triples(typingctx, array, index):
    """Sixteen pixels of a flat uint8 picture as words, red + green << 8 + blue << 16, from ``array[index]`` on."""
    sig = i32x16(array, index)

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        at = builder.gep(data, [context.cast(builder, args[1], sig.args[1], types.intp)], inbounds=True)
        triples = ir.VectorType(_BYTE, 3 * LANES)
        value = builder.load(builder.bitcast(at, triples.as_pointer()))
        value.align = 1
        zeros = ir.Constant(triples, None)
        order = [k for i in range(LANES) for k in (3 * i, 3 * i + 1, 3 * i + 2, 3 * LANES)]
        return builder.bitcast(_shuffle(builder, value, zeros, order), _INTS)

    return sig, codegen


@intrinsic
def store_pairs(typingctx, array, index, low, high):
    """Write 16 words to a contiguous uint64 array: float lanes as their low halves, int lanes as their high ones."""
    sig = types.void(array, index, low, high)

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        at = builder.gep(data, [context.cast(builder, args[1], sig.args[1], types.intp)], inbounds=True)
        order = [i // 2 + LANES * (i % 2) for i in range(2 * LANES)]
        mixed = _shuffle(builder, builder.bitcast(args[2], _INTS), args[3], order)
        written = builder.store(mixed, builder.bitcast(at, mixed.type.as_pointer()))
        written.align = 8
        return context.get_dummy_value()

    return sig, codegen


@intrinsic
def mark(typingctx, array, index):
    """``array[index] = 1`` for every lane, in a one-dimensional contiguous uint8 array; the bounds are the caller's."""
    sig = types.void(array, i32x16)

    def codegen(context, builder, sig, args):
        for i in range(LANES):
            at = _element(context, builder, sig.args[0], args[0], builder.extract_element(args[1], _lane(i)))
            builder.store(ir.Constant(_BYTE, 1), at)
        return context.get_dummy_value()

    return sig, codegen


@intrinsic
def float_bits(typingctx, scalar):
    """The 32 bits of a float32 as uint32."""
    return types.uint32(types.float32), lambda context, builder, sig, args: builder.bitcast(args[0], _INT)


@intrinsic
def prefetch(typingctx, array, index):
    """Ask for the cache line of ``array[index]``, soon to be written."""
    sig = types.void(array, index)

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        at = builder.gep(data, [context.cast(builder, args[1], sig.args[1], types.intp)], inbounds=True)
        at = builder.bitcast(at, ir.PointerType())
        kind = ir.FunctionType(ir.VoidType(), [ir.PointerType(), _INT, _INT, _INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [at, _lane(1), _lane(3), _lane(1)])
        return context.get_dummy_value()

    return sig, codegen


@intrinsic
def count_lanes(typingctx, mask):
    """Number of true lanes, int64."""

    def codegen(context, builder, sig, args):
        bits = builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))
        return builder.ctpop(bits)

    return types.int64(mask), codegen
