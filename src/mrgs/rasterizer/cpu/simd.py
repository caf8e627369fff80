"""Vectors of eight floats for Numba, so that the kernels do not depend on LLVM's auto-vectoriser.

A ``Float32x8`` lives in one AVX register (or two NEON registers). Inside ``@njit`` functions it takes ``+ - *``,
comparisons (which give a ``Mask8``), ``&`` on masks, and the functions below. Multiply-adds are fused where the
machine has the instruction.
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

LANES = 8

_F32 = ir.FloatType()
_I32 = ir.IntType(32)
_VECTOR = ir.VectorType(_F32, LANES)
_VECTOR_I32 = ir.VectorType(_I32, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)
_FUSE = ("contract",)


class _Float32x8(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Float32x8")


class _Mask8(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Mask8")


Float32x8 = _Float32x8()
Mask8 = _Mask8()
FloatPointer = types.CPointer(types.float32)


@register_model(_Float32x8)
class _Float32x8Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


@register_model(_Mask8)
class _Mask8Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _MASK)


def _define_operator(function: Callable, operand: types.Type, result: types.Type, emit: Callable) -> None:
    """Teach Numba ``function(operand, operand) -> result``; ``emit(builder, a, b)`` writes the instruction."""

    class Template(ConcreteTemplate):
        cases = [signature(result, operand, operand)]  # noqa: RUF012

    infer_global(function)(Template)

    @lower_builtin(function, operand, operand)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *args)


_define_operator(operator.add, Float32x8, Float32x8, lambda b, x, y: b.fadd(x, y, flags=_FUSE))
_define_operator(operator.sub, Float32x8, Float32x8, lambda b, x, y: b.fsub(x, y, flags=_FUSE))
_define_operator(operator.mul, Float32x8, Float32x8, lambda b, x, y: b.fmul(x, y, flags=_FUSE))
_define_operator(operator.truediv, Float32x8, Float32x8, lambda b, x, y: b.fdiv(x, y))
_define_operator(operator.ge, Float32x8, Mask8, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_define_operator(operator.lt, Float32x8, Mask8, lambda b, x, y: b.fcmp_ordered("<", x, y))
_define_operator(operator.and_, Mask8, Mask8, lambda b, x, y: b.and_(x, y))
_define_operator(operator.or_, Mask8, Mask8, lambda b, x, y: b.or_(x, y))


def _broadcast(builder: Any, scalar: Any, vector_type: ir.VectorType = _VECTOR) -> Any:
    undefined = ir.Constant(vector_type, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    lanes = ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, lanes)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [value] * LANES)


def _element(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """The address ``args[0] + args[1]`` of an element behind a pointer."""
    return builder.gep(args[0], [context.cast(builder, args[1], sig.args[1], types.int64)])


@intrinsic
def broadcast(typingctx: Any, value: Any) -> Any:
    """float32 -> all lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        scalar = context.cast(builder, args[0], sig.args[0], types.float32)
        return _broadcast(builder, scalar)

    return Float32x8(value), codegen


@intrinsic
def lane_indices(typingctx: Any) -> Any:
    """(0, 1, ..., 7) as floats."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return ir.Constant(_VECTOR, [float(lane) for lane in range(LANES)])

    return Float32x8(), codegen


# Pointers, because Numba counts references to every array that is passed to a function, in the innermost loops too.


@intrinsic
def pointer(typingctx: Any, array: Any) -> Any:
    """Address of a contiguous float32 array's first element; the caller keeps the array alive."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return context.make_array(sig.args[0])(context, builder, args[0]).data

    return FloatPointer(array), codegen


@intrinsic(prefer_literal=True)
def stack_floats(typingctx: Any, count: Any) -> Any:
    """Address of ``count`` floats on the stack, set to 0; ``count`` is a constant."""
    size = count.literal_value

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        block = cgutils.alloca_once(builder, ir.ArrayType(_F32, size))
        cgutils.memset(builder, block, ir.Constant(ir.IntType(64), 4 * size), 0)
        return builder.bitcast(block, _F32.as_pointer())

    return FloatPointer(count), codegen


@intrinsic
def read(typingctx: Any, floats: Any, index: Any) -> Any:
    """The float at ``index`` behind a pointer; unchecked, as all below."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_element(context, builder, sig, args))

    return types.float32(FloatPointer, index), codegen


@intrinsic
def write(typingctx: Any, floats: Any, index: Any, value: Any) -> Any:
    """The counterpart of ``read``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(context.cast(builder, args[2], sig.args[2], types.float32), _element(context, builder, sig, args))
        return context.get_dummy_value()

    return types.void(FloatPointer, index, value), codegen


@intrinsic
def load(typingctx: Any, floats: Any, index: Any) -> Any:
    """Eight consecutive floats behind a pointer, from ``index``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = builder.bitcast(_element(context, builder, sig, args), _VECTOR.as_pointer())
        return builder.load(address, align=4)

    return Float32x8(FloatPointer, index), codegen


@intrinsic
def store(typingctx: Any, floats: Any, index: Any, vector: Any) -> Any:
    """The counterpart of ``load``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = builder.bitcast(_element(context, builder, sig, args), _VECTOR.as_pointer())
        builder.store(args[2], address, align=4)
        return context.get_dummy_value()

    return types.void(FloatPointer, index, Float32x8), codegen


@intrinsic
def select(typingctx: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Lane by lane: ``yes`` where the mask is set, else ``no``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(*args)

    return Float32x8(Mask8, Float32x8, Float32x8), codegen


@intrinsic
def minimum(typingctx: Any, a: Any, b: Any) -> Any:
    """Lane by lane minimum."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[0], args[1])

    return Float32x8(Float32x8, Float32x8), codegen


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """Whether any lane of the mask is set."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(Mask8), codegen


@intrinsic
def sum_lanes(typingctx: Any, vector: Any) -> Any:
    """Sum of the lanes, always in the same order (a binary tree)."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        total = args[0]
        half = LANES // 2
        while half:
            lanes = [lane + half if lane < half else lane for lane in range(LANES)]
            upper = builder.shuffle_vector(total, total, ir.Constant(ir.VectorType(_I32, LANES), lanes))
            total = builder.fadd(total, upper)
            half //= 2
        return builder.extract_element(total, ir.Constant(_I32, 0))

    return types.float32(Float32x8), codegen


# 2^f on [-1/2, 1/2], interpolated at the Chebyshev nodes: relative error 1e-7.
_EXP2_COEFFICIENTS = (1.00000008, 0.69314719, 0.24022107, 0.05550357, 0.00967603, 0.00133909)


@intrinsic
def exp2(typingctx: Any, vector: Any) -> Any:
    """2 to the power of each lane, for arguments up to 127; below -126 it stays at 2^-126."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = builder.select(builder.fcmp_ordered(">", args[0], _constant(-126.0)), args[0], _constant(-126.0))
        round_to_nearest = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), f"llvm.rint.v{LANES}f32"
        )
        whole = builder.call(round_to_nearest, [x])
        fraction = builder.fsub(x, whole)
        power = _constant(_EXP2_COEFFICIENTS[-1])
        for coefficient in reversed(_EXP2_COEFFICIENTS[:-1]):
            power = builder.fadd(builder.fmul(power, fraction, flags=_FUSE), _constant(coefficient), flags=_FUSE)
        exponent = builder.fptosi(whole, _VECTOR_I32)
        shifted = builder.shl(exponent, ir.Constant(_VECTOR_I32, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(power, _VECTOR_I32), shifted), _VECTOR)

    return Float32x8(Float32x8), codegen
