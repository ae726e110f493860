"""Sixteen lanes as one value inside numba functions, so that vector code does not hang on the
auto-vectoriser.

``f32x16`` is an LLVM ``<16 x float>``: one register with AVX-512, two with AVX2, four with SSE or
NEON; LLVM splits it by itself. Comparison gives a mask (``<16 x i1>``). ``i32x16`` are integers
beside them: indices, lookups through them, and marks in a byte map. Operators ``+ - * <, >=, &``
work between vectors; a scalar is made a vector with ``splat``.

Bounds are the caller's everywhere; a lookup reads no lane that its mask excludes. The lookups need
opaque pointers, that is numba 0.62 (llvmlite 0.45) or later.
"""

import operator
from collections.abc import Callable

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.extending import intrinsic, lower_builtin, register_model
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature

LANES = 16

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_BYTE = ir.IntType(8)
_WIDE = ir.IntType(64)
_FLOATS = ir.VectorType(_FLOAT, LANES)
_INTS = ir.VectorType(_INT, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


class _Lanes(types.Type):
    def __init__(self, name: str):
        super().__init__(name=name)


f32x16 = _Lanes("f32x16")
i32x16 = _Lanes("i32x16")
mask16 = _Lanes("mask16")


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        vectors = {"f32x16": _FLOATS, "i32x16": _INTS, "mask16": _MASK}
        super().__init__(dmm, fe_type, vectors[fe_type.name])


def _lane(i: int) -> ir.Constant:
    return ir.Constant(_INT, i)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [ir.Constant(_FLOAT, value)] * LANES)


def _splat(scalar_type, result, vector):
    @intrinsic
    def operation(typingctx, scalar):
        def codegen(context, builder, sig, args):
            empty = ir.Constant(vector, ir.Undefined)
            one = builder.insert_element(empty, args[0], _lane(0))
            return builder.shuffle_vector(one, empty, ir.Constant(_INTS, [_lane(0)] * LANES))

        return result(scalar_type), codegen

    return operation


splat = _splat(types.float32, f32x16, _FLOATS)
"""All lanes equal to a float32."""
splat_int = _splat(types.int32, i32x16, _INTS)
"""All lanes equal to an int32."""


def splat_of_class(number_of: Callable[[type], int]):
    """All lanes equal to ``number_of`` the class of a named tuple, which is known when the caller
    is compiled."""

    @intrinsic
    def operation(typingctx, value):
        constant = ir.Constant(_INTS, [_lane(number_of(value.instance_class))] * LANES)
        return i32x16(value), lambda context, builder, sig, args: constant

    return operation


@intrinsic
def iota(typingctx):
    """0, 1, ..., 15."""
    value = ir.Constant(_FLOATS, [ir.Constant(_FLOAT, float(i)) for i in range(LANES)])
    return f32x16(), lambda context, builder, sig, args: value


def _address(context, builder, sig, args, of):
    """Where ``array[index]``, the first two arguments, is: the address of a value of the type
    ``of``."""
    array = context.make_array(sig.args[0])(context, builder, args[0])
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    return builder.bitcast(builder.gep(array.data, [index], inbounds=True), of.as_pointer())


@intrinsic
def load(typingctx, array, index):
    """Lanes from 16 consecutive elements of a one-dimensional contiguous float32 array; the bounds
    are the caller's."""
    sig = f32x16(array, index)

    def codegen(context, builder, sig, args):
        value = builder.load(_address(context, builder, sig, args, _FLOATS))
        value.align = 4
        return value

    return sig, codegen


@intrinsic
def store(typingctx, array, index, vector):
    """Write 16 lanes to consecutive elements of a one-dimensional contiguous float32 array."""
    sig = types.void(array, index, vector)

    def codegen(context, builder, sig, args):
        instruction = builder.store(args[2], _address(context, builder, sig, args, _FLOATS))
        instruction.align = 4
        return context.get_dummy_value()

    return sig, codegen


def _binary(emit, result):
    @intrinsic
    def operation(typingctx, a, b):
        return result(a, b), lambda context, builder, sig, args: emit(builder, *args)

    return operation


maximum = _binary(lambda b, x, y: b.select(b.fcmp_ordered(">", x, y), x, y), f32x16)
minimum = _binary(lambda b, x, y: b.select(b.fcmp_ordered("<", x, y), x, y), f32x16)
times = _binary(lambda b, x, y: b.fmul(x, y), f32x16)
"""A product rounded by itself, never fused with a following addition: for results that must repeat
the reference's."""
either = _binary(lambda b, x, y: b.or_(x, y), mask16)
but_not = _binary(lambda b, x, y: b.and_(x, b.not_(y)), mask16)
"""``a`` and not ``b``, two masks."""
below = _binary(lambda b, x, y: b.icmp_unsigned("<", x, y), mask16)
"""``0 <= x < y`` for integers of which y is not negative."""


def _let(symbol, argument, emit, result):
    """Let the operator ``symbol`` between two vectors of the type ``argument`` mean the instruction
    that ``emit`` writes.

    Each is typed and written at once; as an ``overload`` it would be compiled as a function of its
    own first.
    """

    class Operator(ConcreteTemplate):
        cases = [signature(result, argument, argument)]  # noqa: RUF012  (numba reads it so)

    infer_global(symbol)(Operator)  # pyright: ignore[reportOptionalCall]  # a decorator here
    lower_builtin(symbol, argument, argument)(
        lambda context, builder, sig, args: emit(builder, *args)
    )


for _symbol, _type, _emit, _result in (
    (operator.add, f32x16, lambda b, x, y: b.fadd(x, y, flags=("contract",)), f32x16),
    (operator.sub, f32x16, lambda b, x, y: b.fsub(x, y, flags=("contract",)), f32x16),
    (operator.mul, f32x16, lambda b, x, y: b.fmul(x, y, flags=("contract",)), f32x16),
    (operator.truediv, f32x16, lambda b, x, y: b.fdiv(x, y), f32x16),
    (operator.lt, f32x16, lambda b, x, y: b.fcmp_ordered("<", x, y), mask16),
    (operator.ge, f32x16, lambda b, x, y: b.fcmp_ordered(">=", x, y), mask16),
    (operator.gt, f32x16, lambda b, x, y: b.fcmp_ordered(">", x, y), mask16),
    (operator.and_, mask16, lambda b, x, y: b.and_(x, y), mask16),
    (operator.add, i32x16, lambda b, x, y: b.add(x, y), i32x16),
    (operator.sub, i32x16, lambda b, x, y: b.sub(x, y), i32x16),
    (operator.mul, i32x16, lambda b, x, y: b.mul(x, y), i32x16),
    (operator.and_, i32x16, lambda b, x, y: b.and_(x, y), i32x16),
    (operator.rshift, i32x16, lambda b, x, y: b.ashr(x, y), i32x16),
    (operator.eq, i32x16, lambda b, x, y: b.icmp_signed("==", x, y), mask16),
    (operator.ge, i32x16, lambda b, x, y: b.icmp_signed(">=", x, y), mask16),
):
    _let(_symbol, _type, _emit, _result)


def _select(result):
    @intrinsic
    def operation(typingctx, mask, a, b):
        return result(mask, a, b), lambda context, builder, sig, args: builder.select(*args)

    return operation


select = _select(f32x16)
select_int = _select(i32x16)
"""Lane of the first vector where the mask is true, else of the second."""


def _unary(name):
    @intrinsic
    def operation(typingctx, vector):
        def codegen(context, builder, sig, args):
            kind = ir.FunctionType(_FLOATS, [_FLOATS])
            function = cgutils.get_or_insert_function(
                builder.module, kind, f"llvm.{name}.v{LANES}f32"
            )
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
        sign = ir.Constant(_INTS, [ir.Constant(_INT, 1 << 31)] * LANES)
        return builder.bitcast(builder.or_(builder.bitcast(args[0], _INTS), sign), _FLOATS)

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
        empty = ir.Constant(_FLOATS, ir.Undefined)
        while half:
            order = [i + half if i < half else 0 for i in range(LANES)]
            picks = ir.Constant(_INTS, [ir.Constant(_INT, i) for i in order])
            value = builder.fadd(value, builder.shuffle_vector(value, empty, picks))
            half //= 2
        return builder.extract_element(value, ir.Constant(_INT, 0))

    return types.float32(vector), codegen


_EXP2_POLYNOMIAL = (
    1.339086336465688e-3,
    9.676031918321835e-3,
    5.5503571142191524e-2,
    2.4022107485308328e-1,
    6.931471880262287e-1,
    1.000000075454897,
)
"""2^f, highest power first: the polynomial through 2^f at the six Chebyshev nodes of |f| <= 1/2;
1e-7 relative."""


@intrinsic
def exp(typingctx, vector):
    """e^x for -87 < x <= 0, relative error 5e-7 down to -6 and 5e-6 at the end; below, meaningless
    bits.

    x log2(e) = n + f with n an integer; 2^f by polynomial, 2^n by adding n to the exponent bits.
    """

    def codegen(context, builder, sig, args):
        fma = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_FLOATS, [_FLOATS] * 3), f"llvm.fma.v{LANES}f32"
        )
        t = builder.fmul(args[0], _constant(1.4426950408889634))
        # 1.5 * 2^23: adding it rounds to an integer held in the low mantissa bits
        magic = _constant(12582912.0)
        biased_t = builder.fadd(t, magic)
        f = builder.fsub(t, builder.fsub(biased_t, magic))
        p = _constant(_EXP2_POLYNOMIAL[0])
        for c in _EXP2_POLYNOMIAL[1:]:
            p = builder.call(fma, [p, f, _constant(c)])
        twenty_three = ir.Constant(_INTS, [ir.Constant(_INT, 23)] * LANES)
        n = builder.shl(builder.bitcast(biased_t, _INTS), twenty_three)
        return builder.bitcast(builder.add(builder.bitcast(p, _INTS), n), _FLOATS)

    return f32x16(vector), codegen


@intrinsic
def truncate(typingctx, vector):
    """Lanes rounded towards zero, as integers; the values must fit."""
    return i32x16(vector), lambda context, builder, sig, args: builder.fptosi(args[0], _INTS)


def _gathered(context, builder, sig, args, scalar, otherwise):
    """``array[index]`` of the first three arguments, an array of ``scalar``: ``otherwise`` where
    the mask is false."""
    vector = otherwise.type
    pointers = ir.VectorType(ir.PointerType(), LANES)
    data = context.make_array(sig.args[0])(context, builder, args[0]).data
    at = builder.gep(data, [args[1]], inbounds=True, source_etype=scalar)
    at.type = pointers
    kind = ir.FunctionType(vector, [pointers, _INT, _MASK, vector])
    bits = "f32" if scalar == _FLOAT else str(scalar)
    name = f"llvm.masked.gather.v{LANES}{bits}.v{LANES}p0"
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(function, [at, _lane(8 if scalar == _WIDE else 4), args[2], otherwise])


def _gather(scalar, result):
    @intrinsic
    def operation(typingctx, array, index, mask, otherwise):
        def codegen(context, builder, sig, args):
            return _gathered(context, builder, sig, args, scalar, args[3])

        return result(array, i32x16, mask16, result), codegen

    return operation


gather = _gather(_FLOAT, f32x16)
gather_int = _gather(_INT, i32x16)
"""``gather(array, index, mask, otherwise)``: ``array[index]`` where the mask is true; a flat array
of 32 bits."""


@intrinsic
def gather_pairs(typingctx, array, index, mask, otherwise):
    """Both halves of ``array[index]`` of a contiguous uint64 array: low 32 bits as float lanes,
    high 32 as int lanes.

    Where the mask is false: ``otherwise`` and 0. One lookup of 64 bits costs as much as one of 32.
    """
    sig = types.Tuple((f32x16, i32x16))(array, i32x16, mask16, f32x16)

    def codegen(context, builder, sig, args):
        wides = ir.VectorType(_WIDE, LANES)
        fallback = builder.zext(builder.bitcast(args[3], _INTS), wides)
        pair = _gathered(context, builder, sig, args, _WIDE, fallback)
        low = builder.bitcast(builder.trunc(pair, _INTS), _FLOATS)
        high = builder.trunc(
            builder.lshr(pair, ir.Constant(wides, [ir.Constant(_WIDE, 32)] * LANES)), _INTS
        )
        return context.make_tuple(builder, sig.return_type, (low, high))

    return sig, codegen


def _byte(shift):
    @intrinsic
    def operation(typingctx, vector):
        def codegen(context, builder, sig, args):
            word = builder.lshr(args[0], ir.Constant(_INTS, [_lane(shift)] * LANES))
            byte = builder.and_(word, ir.Constant(_INTS, [_lane(255)] * LANES))
            return builder.sitofp(byte, _FLOATS)

        return f32x16(vector), codegen

    return operation


first_byte = _byte(0)
second_byte = _byte(8)
third_byte = _byte(16)
"""The lowest, second and third byte of every lane, as float lanes."""


def _shuffle(builder, a, b, picks):
    order = ir.Constant(ir.VectorType(_INT, len(picks)), [_lane(i) for i in picks])
    return builder.shuffle_vector(a, b, order)


@intrinsic
def byte_triples(typingctx, array, index):
    """Sixteen pixels of a flat uint8 picture as words, red + green << 8 + blue << 16, from
    ``array[index]`` on."""
    sig = i32x16(array, index)

    def codegen(context, builder, sig, args):
        triples = ir.VectorType(_BYTE, 3 * LANES)
        value = builder.load(_address(context, builder, sig, args, triples))
        value.align = 1
        zeros = ir.Constant(triples, None)
        order = [k for i in range(LANES) for k in (3 * i, 3 * i + 1, 3 * i + 2, 3 * LANES)]
        return builder.bitcast(_shuffle(builder, value, zeros, order), _INTS)

    return sig, codegen


@intrinsic
def store_pairs(typingctx, array, index, low, high):
    """Write 16 words to a contiguous uint64 array: float lanes as their low halves, int lanes as
    their high ones."""
    sig = types.void(array, index, low, high)

    def codegen(context, builder, sig, args):
        order = [i // 2 + LANES * (i % 2) for i in range(2 * LANES)]
        pairs = _shuffle(builder, builder.bitcast(args[2], _INTS), args[3], order)
        instruction = builder.store(pairs, _address(context, builder, sig, args, pairs.type))
        instruction.align = 8
        return context.get_dummy_value()

    return sig, codegen


@intrinsic
def load_triples(typingctx, array, index):
    """Sixteen pixels of three numbers from ``array[index]`` on, of a one-dimensional contiguous
    float32 array: the lanes of the first, second and third numbers."""
    sig = types.UniTuple(f32x16, 3)(array, index)

    def codegen(context, builder, sig, args):
        triples = ir.VectorType(_FLOAT, 3 * LANES)
        value = builder.load(_address(context, builder, sig, args, triples))
        value.align = 4
        empty = ir.Constant(triples, ir.Undefined)
        numbers = [_shuffle(builder, value, empty, range(c, 3 * LANES, 3)) for c in range(3)]
        return context.make_tuple(builder, sig.return_type, numbers)

    return sig, codegen


@intrinsic
def store_triples(typingctx, array, index, first, second, third):
    """Write sixteen pixels of three numbers, what ``load_triples`` reads."""
    sig = types.void(array, index, first, second, third)

    def codegen(context, builder, sig, args):
        lanes = range(2 * LANES)
        two = _shuffle(builder, args[2], args[3], lanes)
        # a shuffle takes two vectors of one length
        one = _shuffle(builder, args[4], args[4], lanes)
        order = [c * LANES + i for i in range(LANES) for c in range(3)]
        triples = _shuffle(builder, two, one, order)
        instruction = builder.store(triples, _address(context, builder, sig, args, triples.type))
        instruction.align = 4
        return context.get_dummy_value()

    return sig, codegen


@intrinsic
def store_wide(typingctx, array, index, vector):
    """Write lanes that are whole numbers to consecutive elements of a one-dimensional contiguous
    int64 array."""
    sig = types.void(array, index, vector)

    def codegen(context, builder, sig, args):
        wides = ir.VectorType(_WIDE, LANES)
        numbers = builder.fptosi(args[2], wides)
        instruction = builder.store(numbers, _address(context, builder, sig, args, wides))
        instruction.align = 8
        return context.get_dummy_value()

    return sig, codegen


@intrinsic
def mark(typingctx, array, index):
    """``array[index] = 1`` for every lane, in a one-dimensional contiguous uint8 array; the bounds
    are the caller's."""
    sig = types.void(array, i32x16)

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        for i in range(LANES):
            at = builder.sext(builder.extract_element(args[1], _lane(i)), _WIDE)
            builder.store(ir.Constant(_BYTE, 1), builder.gep(data, [at], inbounds=True))
        return context.get_dummy_value()

    return sig, codegen


@intrinsic
def float_bits(typingctx, scalar):
    """The 32 bits of a float32 as uint32."""
    return types.uint32(types.float32), lambda context, builder, sig, args: builder.bitcast(
        args[0], _INT
    )


@intrinsic
def prefetch(typingctx, array, index):
    """Ask for the cache line of ``array[index]``, soon to be written."""
    sig = types.void(array, index)

    def codegen(context, builder, sig, args):
        at = builder.bitcast(_address(context, builder, sig, args, _BYTE), ir.PointerType())
        kind = ir.FunctionType(ir.VoidType(), [ir.PointerType(), _INT, _INT, _INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [at, _lane(1), _lane(3), _lane(1)])
        return context.get_dummy_value()

    return sig, codegen


@intrinsic
def count_lanes(typingctx, mask):
    """Number of true lanes, int64."""

    def codegen(context, builder, sig, args):
        bits = builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), _WIDE)
        return builder.ctpop(bits)

    return types.int64(mask), codegen
