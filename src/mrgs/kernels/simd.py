"""Vectors of sixteen floats for Numba, so that the kernels do not depend on LLVM's auto-vectoriser.

A ``Float32x16`` lives in one AVX-512 register, or in two of AVX, or in four of NEON. Inside
``@njit`` functions it takes ``+ - *``, comparisons (which give a ``Mask16``), ``&`` on masks, and
the functions below. Multiply-adds are fused where the machine has the instruction.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16

F32 = ir.FloatType()
_I32 = ir.IntType(32)
VECTOR = ir.VectorType(F32, LANES)
_VECTOR_I32 = ir.VectorType(_I32, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)
FUSE = ("contract",)


class _Lanes(types.Type):
    """Sixteen values in one LLVM vector."""

    def __init__(self, name: str, vector: ir.VectorType) -> None:
        super().__init__(name=name)
        self.vector = vector


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, fe_type.vector)


Float32x16, Mask16 = _Lanes("Float32x16", VECTOR), _Lanes("Mask16", _MASK)
FloatPointer = types.CPointer(types.float32)


def _define_operator(
    function: Callable, operand: types.Type, result: types.Type, emit: Callable
) -> None:
    """Teach Numba ``function(operand, operand) -> result``; ``emit(builder, a, b)`` writes it."""

    class Template(ConcreteTemplate):
        cases = [signature(result, operand, operand)]  # noqa: RUF012

    infer_global(function)(Template)

    @lower_builtin(function, operand, operand)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *args)


_define_operator(operator.add, Float32x16, Float32x16, lambda b, x, y: b.fadd(x, y, flags=FUSE))
_define_operator(operator.sub, Float32x16, Float32x16, lambda b, x, y: b.fsub(x, y, flags=FUSE))
_define_operator(operator.mul, Float32x16, Float32x16, lambda b, x, y: b.fmul(x, y, flags=FUSE))
_define_operator(operator.truediv, Float32x16, Float32x16, lambda b, x, y: b.fdiv(x, y))
_define_operator(operator.ge, Float32x16, Mask16, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_define_operator(operator.lt, Float32x16, Mask16, lambda b, x, y: b.fcmp_ordered("<", x, y))
_define_operator(operator.and_, Mask16, Mask16, lambda b, x, y: b.and_(x, y))
_define_operator(operator.or_, Mask16, Mask16, lambda b, x, y: b.or_(x, y))


def in_all_lanes(builder: Any, scalar: Any) -> Any:
    """The instructions of ``broadcast``."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    lanes = ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, lanes)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(VECTOR, [value] * LANES)


def _element(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """The address ``args[0] + args[1]`` of an element behind a pointer."""
    return builder.gep(args[0], [context.cast(builder, args[1], sig.args[1], types.int64)])


@intrinsic
def broadcast(typingctx: Any, value: Any) -> Any:
    """float32 -> all lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        scalar = context.cast(builder, args[0], sig.args[0], types.float32)
        return in_all_lanes(builder, scalar)

    return Float32x16(value), codegen


def _lane_constants(value: Callable[[int, int], float]) -> Callable:
    """A kernel function of a constant ``width`` that gives each lane ``value(lane, width)``."""

    @intrinsic(prefer_literal=True)
    def constants(typingctx: Any, width: Any) -> Any:
        values = [float(value(lane, width.literal_value)) for lane in range(LANES)]
        return Float32x16(width), lambda context, builder, sig, args: ir.Constant(VECTOR, values)

    return constants


lane_columns = _lane_constants(lambda lane, width: lane % width)
"""The column of each lane if the lanes fill rows of ``width`` one after the other."""

lane_rows = _lane_constants(lambda lane, width: lane // width)
"""The row of each lane if the lanes fill rows of ``width`` one after the other."""


# Addresses (``jit.address``), because Numba counts references to every array that is passed to a
# function, in the innermost loops too.


@intrinsic(prefer_literal=True)
def stack_floats(typingctx: Any, count: Any) -> Any:
    """Address of ``count`` floats on the stack, set to 0; ``count`` is a constant."""
    size = count.literal_value

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        block = cgutils.alloca_once(builder, ir.ArrayType(F32, size))
        cgutils.memset(builder, block, ir.Constant(ir.IntType(64), 4 * size), 0)
        return builder.bitcast(block, F32.as_pointer())

    return FloatPointer(count), codegen


@intrinsic
def prefetch(typingctx: Any, floats: Any, index: Any) -> Any:
    """Ask for the cache line behind a pointer, at ``index``, which may lie anywhere."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = builder.bitcast(_element(context, builder, sig, args), ir.IntType(8).as_pointer())
        signature_ = ir.FunctionType(ir.VoidType(), [address.type, _I32, _I32, _I32])
        function = cgutils.get_or_insert_function(builder.module, signature_, "llvm.prefetch.p0i8")
        builder.call(function, [address, *(ir.Constant(_I32, value) for value in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(FloatPointer, index), codegen


@intrinsic
def load(typingctx: Any, floats: Any, index: Any) -> Any:
    """Sixteen consecutive floats behind a pointer, from ``index``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = builder.bitcast(_element(context, builder, sig, args), VECTOR.as_pointer())
        return builder.load(address, align=4)

    return Float32x16(FloatPointer, index), codegen


@intrinsic
def store(typingctx: Any, floats: Any, index: Any, vector: Any) -> Any:
    """The counterpart of ``load``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = builder.bitcast(_element(context, builder, sig, args), VECTOR.as_pointer())
        builder.store(args[2], address, align=4)
        return context.get_dummy_value()

    return types.void(FloatPointer, index, Float32x16), codegen


def _rounded_to_int(instruction: str) -> Callable:
    """A kernel function from float32 to int64 that rounds as the LLVM instruction does."""

    @intrinsic
    def rounded(typingctx: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            function = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(F32, [F32]), instruction
            )
            return builder.fptosi(builder.call(function, [args[0]]), ir.IntType(64))

        return types.int64(types.float32), codegen

    return rounded


# Those of ``math`` are calls into the C library, which spill every vector register.
ceil_to_int = _rounded_to_int("llvm.ceil.f32")
floor_to_int = _rounded_to_int("llvm.floor.f32")


@intrinsic
def select(typingctx: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Lane by lane: ``yes`` where the mask is set, else ``no``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(*args)

    return Float32x16(Mask16, Float32x16, Float32x16), codegen


@intrinsic
def minimum(typingctx: Any, a: Any, b: Any) -> Any:
    """Lane by lane minimum."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[0], args[1])

    return Float32x16(Float32x16, Float32x16), codegen


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """Whether any lane of the mask is set."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(Mask16), codegen


@intrinsic
def store_sums(typingctx: Any, floats: Any, index: Any, vectors: Any) -> Any:
    """The sum over the lanes of each of up to sixteen vectors (a tuple) to consecutive floats, from
    ``index``. Vectors are folded together, halving their number and lanes, in one order."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        folded = cgutils.unpack_tuple(builder, args[2])
        count, width = len(folded), LANES
        while width > 1:
            folded += [_constant(0.0)] * (len(folded) % 2)
            width //= 2
            halves = [
                [lane for lane in range(2 * LANES) if lane // width % 2 == half] for half in (0, 1)
            ]
            masks = [ir.Constant(ir.VectorType(_I32, LANES), lanes) for lanes in halves]
            folded = [
                builder.fadd(*(builder.shuffle_vector(one, other, mask) for mask in masks))
                for one, other in zip(folded[::2], folded[1::2], strict=True)
            ]
        (sums,) = folded
        kept = builder.shuffle_vector(
            sums, sums, ir.Constant(ir.VectorType(_I32, count), list(range(count)))
        )
        address = builder.bitcast(
            _element(context, builder, sig, args), ir.VectorType(F32, count).as_pointer()
        )
        builder.store(kept, address, align=4)
        return context.get_dummy_value()

    return types.void(FloatPointer, index, vectors), codegen


# 2^f on [-1/2, 1/2], interpolated at the Chebyshev nodes: relative error 1e-7.
_EXP2_COEFFICIENTS = (1.00000008, 0.69314719, 0.24022107, 0.05550357, 0.00967603, 0.00133909)


@intrinsic
def exp2(typingctx: Any, vector: Any) -> Any:
    """2 to the power of each lane, for arguments up to 127; below -126 it stays at 2^-126."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = builder.select(
            builder.fcmp_ordered(">", args[0], _constant(-126.0)), args[0], _constant(-126.0)
        )
        round_to_nearest = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(VECTOR, [VECTOR]), f"llvm.rint.v{LANES}f32"
        )
        whole = builder.call(round_to_nearest, [x])
        fraction = builder.fsub(x, whole)
        power = _constant(_EXP2_COEFFICIENTS[-1])
        for coefficient in reversed(_EXP2_COEFFICIENTS[:-1]):
            power = builder.fadd(
                builder.fmul(power, fraction, flags=FUSE), _constant(coefficient), flags=FUSE
            )
        exponent = builder.fptosi(whole, _VECTOR_I32)
        shifted = builder.shl(exponent, ir.Constant(_VECTOR_I32, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(power, _VECTOR_I32), shifted), VECTOR)

    return Float32x16(Float32x16), codegen
