"""Sixteen float32 lanes as one value inside numba functions, so that vector code does not hang on the auto-vectoriser.

``f32x16`` is an LLVM ``<16 x float>``: one register with AVX-512, two with AVX2, four with SSE or NEON; LLVM splits it
by itself. Comparison gives a mask (``<16 x i1>``). Operators ``+ - * <, >=, &`` work between vectors; a scalar is made
a vector with ``splat``.
"""

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.extending import intrinsic, overload, register_model

LANES = 16

_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, LANES)
_INT_VECTOR = ir.VectorType(ir.IntType(32), LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


class _F32x16(types.Type):
    def __init__(self):
        super().__init__(name="f32x16")


class _Mask16(types.Type):
    def __init__(self):
        super().__init__(name="mask16")


f32x16 = _F32x16()
mask16 = _Mask16()


@register_model(_F32x16)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _VECTOR)


@register_model(_Mask16)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _MASK)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_FLOAT, value)] * LANES)


def _broadcast(builder, scalar):
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [ir.Constant(ir.IntType(32), 0)] * LANES)
    return builder.shuffle_vector(one, ir.Constant(_VECTOR, ir.Undefined), zeros)


@intrinsic
def splat(typingctx, scalar):
    """All lanes equal to a float32."""
    sig = f32x16(types.float32)
    return sig, lambda context, builder, sig, args: _broadcast(builder, args[0])


@intrinsic
def iota(typingctx):
    """0, 1, ..., 15."""
    value = ir.Constant(_VECTOR, [ir.Constant(_FLOAT, float(i)) for i in range(LANES)])
    return f32x16(), lambda context, builder, sig, args: value


def _address(context, builder, sig, args):
    array_type = sig.args[0]
    array = context.make_array(array_type)(context, builder, args[0])
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    pointer = builder.gep(array.data, [index], inbounds=True)
    return builder.bitcast(pointer, _VECTOR.as_pointer())


@intrinsic
def load(typingctx, array, index):
    """Lanes from 16 consecutive elements of a one-dimensional contiguous float32 array; the bounds are the caller's."""
    sig = f32x16(array, index)

    def codegen(context, builder, sig, args):
        value = builder.load(_address(context, builder, sig, args))
        value.align = 4
        return value

    return sig, codegen


@intrinsic
def store(typingctx, array, index, vector):
    """Write 16 lanes to consecutive elements of a one-dimensional contiguous float32 array."""
    sig = types.void(array, index, vector)

    def codegen(context, builder, sig, args):
        written = builder.store(args[2], _address(context, builder, sig, args))
        written.align = 4
        return context.get_dummy_value()

    return sig, codegen


def _binary(emit, result):
    @intrinsic
    def operation(typingctx, a, b):
        return result(a, b), lambda context, builder, sig, args: emit(builder, *args)

    return operation


_add = _binary(lambda b, x, y: b.fadd(x, y, flags=("contract",)), f32x16)
_sub = _binary(lambda b, x, y: b.fsub(x, y, flags=("contract",)), f32x16)
_mul = _binary(lambda b, x, y: b.fmul(x, y, flags=("contract",)), f32x16)
_div = _binary(lambda b, x, y: b.fdiv(x, y), f32x16)
_lt = _binary(lambda b, x, y: b.fcmp_ordered("<", x, y), mask16)
_ge = _binary(lambda b, x, y: b.fcmp_ordered(">=", x, y), mask16)
_gt = _binary(lambda b, x, y: b.fcmp_ordered(">", x, y), mask16)
_and = _binary(lambda b, x, y: b.and_(x, y), mask16)
maximum = _binary(lambda b, x, y: b.select(b.fcmp_ordered(">", x, y), x, y), f32x16)
times = _binary(lambda b, x, y: b.fmul(x, y), f32x16)
"""A product rounded by itself, never fused with a following addition: for results that must repeat the reference's."""
either = _binary(lambda b, x, y: b.or_(x, y), mask16)
minimum = _binary(lambda b, x, y: b.select(b.fcmp_ordered("<", x, y), x, y), f32x16)


def lane_overload(symbol, operation, argument):
    """Let the operator ``symbol`` between two vectors of the type ``argument`` mean ``operation``."""

    @overload(symbol)
    def _(a, b):
        if a == argument and b == argument:
            return lambda a, b: operation(a, b)
        return None


for _symbol, _operation in (
    (operator.add, _add),
    (operator.sub, _sub),
    (operator.mul, _mul),
    (operator.truediv, _div),
    (operator.lt, _lt),
    (operator.ge, _ge),
    (operator.gt, _gt),
):
    lane_overload(_symbol, _operation, f32x16)
lane_overload(operator.and_, _and, mask16)


@intrinsic
def select(typingctx, mask, a, b):
    """Lane of ``a`` where the mask is true, else of ``b``."""
    return f32x16(mask, a, b), lambda context, builder, sig, args: builder.select(*args)


def _unary(name):
    @intrinsic
    def operation(typingctx, vector):
        def codegen(context, builder, sig, args):
            kind = ir.FunctionType(_VECTOR, [_VECTOR])
            function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
            return builder.call(function, args)

        return f32x16(vector), codegen

    return operation


floor = _unary("floor")
sqrt = _unary("sqrt")
absolute = _unary("fabs")


@intrinsic
def negative_abs(typingctx, vector):
    """-|x|, lane by lane: sets the sign bit."""

    def codegen(context, builder, sig, args):
        sign = ir.Constant(_INT_VECTOR, [ir.Constant(ir.IntType(32), 1 << 31)] * LANES)
        return builder.bitcast(builder.or_(builder.bitcast(args[0], _INT_VECTOR), sign), _VECTOR)

    return f32x16(vector), codegen


@intrinsic
def any_lane(typingctx, mask):
    """Whether any lane of the mask is true."""

    def codegen(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), codegen


@intrinsic
def reduce_add(typingctx, vector):
    """Sum of the lanes, always in the same (tree) order."""

    def codegen(context, builder, sig, args):
        value = args[0]
        half = LANES // 2
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        while half:
            order = [i + half if i < half else 0 for i in range(LANES)]
            picks = ir.Constant(_INT_VECTOR, [ir.Constant(ir.IntType(32), i) for i in order])
            value = builder.fadd(value, builder.shuffle_vector(value, undefined, picks))
            half //= 2
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(vector), codegen


_EXP2_POLYNOMIAL = (
    1.339086336465688e-3,
    9.676031918321835e-3,
    5.5503571142191524e-2,
    2.4022107485308328e-1,
    6.931471880262287e-1,
    1.000000075454897,
)
"""2^f, highest power first: the polynomial through 2^f at the six Chebyshev nodes of |f| <= 1/2; 1e-7 relative."""


@intrinsic
def exp(typingctx, vector):
    """e^x for -87 < x <= 0, relative error 5e-7 down to -6 and 5e-6 at the end; below, meaningless bits.

    x log2(e) = n + f with n an integer; 2^f by polynomial, 2^n by adding n to the exponent bits.
    """

    def codegen(context, builder, sig, args):
        fma = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fma.v{LANES}f32"
        )
        t = builder.fmul(args[0], _constant(1.4426950408889634))
        magic = _constant(12582912.0)  # 1.5 * 2^23: adding it rounds to an integer held in the low mantissa bits
        shifted = builder.fadd(t, magic)
        f = builder.fsub(t, builder.fsub(shifted, magic))
        p = _constant(_EXP2_POLYNOMIAL[0])
        for c in _EXP2_POLYNOMIAL[1:]:
            p = builder.call(fma, [p, f, _constant(c)])
        twenty_three = ir.Constant(_INT_VECTOR, [ir.Constant(ir.IntType(32), 23)] * LANES)
        n = builder.shl(builder.bitcast(shifted, _INT_VECTOR), twenty_three)
        return builder.bitcast(builder.add(builder.bitcast(p, _INT_VECTOR), n), _VECTOR)

    return f32x16(vector), codegen
