"""Matrix products of one block of rows, small enough to stay in the cache: what the heads spend
their time on.

A library's product starts its threads for each call, and may sum in another order when their
number changes. Here each thread multiplies blocks of its own, so that a whole network passes over a
block without leaving the cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mrgs.kernels.jit import reordering_kernel

TILE_ROWS = 4
TILE_COLUMNS = 16
"""A tile of 4 × 16 sums fits into the registers of AVX2 (8 of 16) and of AVX-512 (4 of 32)."""

BLOCK_ROWS = 32
"""Rows that pass through a network together; a multiple of TILE_ROWS."""

_F32 = ir.FloatType()
_I32 = ir.IntType(32)
_I64 = ir.IntType(64)
_VECTOR = ir.VectorType(_F32, TILE_COLUMNS)
_FUSE = ("contract",)


@reordering_kernel
def rounded_up(count, unit):
    """The smallest multiple of ``unit`` that is not below ``count``."""
    return -(-count // unit) * unit


def panels(matrix: np.ndarray) -> np.ndarray:
    """[k, n] as the right factor of ``multiply``: [⌈n / 16⌉, k, 16], filled up with zeros."""
    k, n = matrix.shape
    count = -(-n // TILE_COLUMNS)
    filled_up = np.zeros((k, count * TILE_COLUMNS), np.float32)
    filled_up[:, :n] = matrix
    return np.ascontiguousarray(filled_up.reshape(k, count, TILE_COLUMNS).transpose(1, 0, 2))


@reordering_kernel
def multiply(a, right, start, out):
    """out = start + a · right: rows [R, ≥ k], ``panels`` of [k, n], a bias [n], and rows [R, n]."""
    count, k, _ = right.shape
    for panel in range(count):
        for row in range(0, a.shape[0], TILE_ROWS):
            _tile(
                out.ctypes.data + 4 * (row * out.shape[1] + panel * TILE_COLUMNS), out.shape[1],
                start.ctypes.data + 4 * panel * TILE_COLUMNS, 0,
                a.ctypes.data + 4 * row * a.shape[1], a.shape[1], 1,
                right.ctypes.data + 4 * panel * k * TILE_COLUMNS, TILE_COLUMNS, k,
            )  # fmt: skip


@reordering_kernel
def add_product(a, b, out):
    """out += aᵀ · b: rows [R, m] and [R, n], sums [m, n]; the gradient of a layer's weights.

    m is a multiple of TILE_ROWS, n of TILE_COLUMNS.
    """
    for column in range(0, b.shape[1], TILE_COLUMNS):
        for row in range(0, a.shape[1], TILE_ROWS):
            place = out.ctypes.data + 4 * (row * out.shape[1] + column)
            _tile(
                place, out.shape[1],
                place, out.shape[1],
                a.ctypes.data + 4 * row, 1, a.shape[1],
                b.ctypes.data + 4 * column, b.shape[1], a.shape[0],
            )  # fmt: skip


@intrinsic
def _tile(typingctx, out, out_row, start, start_row, a, a_row, a_k, b, b_k, k):
    """One tile: out[r, :] = start[r, :] + Σ_k a[r, k] b[k, :], from addresses and strides counted
    in floats."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        out, out_row, start, start_row, a, a_row, a_k, b, b_k, k = args

        def at(base: Any, stride: Any, index: Any, kind: Any) -> Any:
            if isinstance(index, int):
                index = ir.Constant(_I64, index)
            offset = builder.mul(builder.mul(stride, index), ir.Constant(_I64, 4))
            return builder.inttoptr(builder.add(base, offset), kind.as_pointer())

        sums = [cgutils.alloca_once(builder, _VECTOR) for _ in range(TILE_ROWS)]
        for row in range(TILE_ROWS):
            builder.store(builder.load(at(start, start_row, row, _VECTOR), align=4), sums[row])
        with cgutils.for_range(builder, k) as loop:
            vector = builder.load(at(b, b_k, loop.index, _VECTOR), align=4)
            column = builder.ptrtoint(at(a, a_k, loop.index, _F32), _I64)
            for row in range(TILE_ROWS):
                factor = _broadcast(builder, builder.load(at(column, a_row, row, _F32)))
                product = builder.fmul(factor, vector, flags=_FUSE)
                builder.store(
                    builder.fadd(builder.load(sums[row]), product, flags=_FUSE), sums[row]
                )
        for row in range(TILE_ROWS):
            builder.store(builder.load(sums[row]), at(out, out_row, row, _VECTOR), align=4)
        return context.get_dummy_value()

    return types.void(*[types.int64] * 10), codegen


def _broadcast(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(
        first, undefined, ir.Constant(ir.VectorType(_I32, TILE_COLUMNS), [0] * TILE_COLUMNS)
    )
