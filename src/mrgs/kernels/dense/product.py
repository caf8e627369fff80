"""Matrix products of one block of rows, small enough to stay in the cache: what the heads spend
their time on.

A library's product starts its threads for each call, and may sum in another order when their
number changes. Here each thread multiplies blocks of its own, so that a whole network passes over a
block without leaving the cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mrgs.kernels.jit import reordering_inner_function, reordering_kernel

TILE_COLUMNS = 16
"""Columns of a vector of sums, and of a panel."""

TILE_ROWS, TILE_VECTORS = (8, 2) if binding.get_host_cpu_features().get("avx512f") else (4, 1)
"""A tile of 4 × 16 sums takes 8 of the 16 registers of AVX2, one of 8 × 32 16 of the 32 of AVX-512:
enough sums at once that none waits for its own last addition, and each value that is loaded is used
several times. The order in which a sum is added up, and so its bits, are the same in any tile."""

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


def _tile_of(vectors: int) -> Callable[..., Any]:
    """A function for kernels that computes one tile of TILE_ROWS × ``vectors`` vectors: out[r, :] =
    start[r, :] + Σ_k a[r, k] b[k, :].

    It takes addresses and strides counted in floats: ``out``, ``out_row``, ``start``,
    ``start_row``, ``a``, ``a_row``, ``a_k``, ``b``, ``b_k``, ``b_vector`` (from one vector of b to
    the next) and k.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        out, out_row, start, start_row, a, a_row, a_k, b, b_k, b_vector, k = args

        def at(base: Any, stride: Any, index: Any, kind: Any) -> Any:
            if isinstance(index, int):
                index = ir.Constant(_I64, index)
            offset = builder.mul(builder.mul(stride, index), ir.Constant(_I64, 4))
            return builder.inttoptr(builder.add(base, offset), kind.as_pointer())

        def vector_at(base: Any, row_stride: Any, row: int, vector: int) -> Any:
            row_start = builder.ptrtoint(at(base, row_stride, row, _VECTOR), _I64)
            return at(row_start, ir.Constant(_I64, TILE_COLUMNS), vector, _VECTOR)

        places = [(row, vector) for row in range(TILE_ROWS) for vector in range(vectors)]
        sums = {place: cgutils.alloca_once(builder, _VECTOR) for place in places}
        for place in places:
            first = builder.load(vector_at(start, start_row, *place), align=4)
            builder.store(first, sums[place])
        with cgutils.for_range(builder, k) as loop:
            row_of_b = builder.ptrtoint(at(b, b_k, loop.index, _VECTOR), _I64)
            loaded = [
                builder.load(at(row_of_b, b_vector, vector, _VECTOR), align=4)
                for vector in range(vectors)
            ]
            column = builder.ptrtoint(at(a, a_k, loop.index, _F32), _I64)
            factors = [
                _broadcast(builder, builder.load(at(column, a_row, row, _F32)))
                for row in range(TILE_ROWS)
            ]
            for row, vector in places:
                product = builder.fmul(factors[row], loaded[vector], flags=_FUSE)
                so_far = builder.load(sums[row, vector])
                builder.store(builder.fadd(so_far, product, flags=_FUSE), sums[row, vector])
        for place in places:
            builder.store(builder.load(sums[place]), vector_at(out, out_row, *place), align=4)
        return context.get_dummy_value()

    @intrinsic
    def tile(typingctx, out, out_row, start, start_row, a, a_row, a_k, b, b_k, b_vector, k):
        return types.void(*[types.int64] * 11), codegen

    return tile


def _broadcast(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(
        first, undefined, ir.Constant(ir.VectorType(_I32, TILE_COLUMNS), [0] * TILE_COLUMNS)
    )


_whole_tile = _tile_of(TILE_VECTORS)
_one_vector = _tile_of(1)


@reordering_inner_function
def _tile(whole, out, out_row, start, start_row, a, a_row, a_k, b, b_k, b_vector, k):
    """A whole tile, or its first vector where no more columns are left."""
    if whole:
        _whole_tile(out, out_row, start, start_row, a, a_row, a_k, b, b_k, b_vector, k)
    else:
        _one_vector(out, out_row, start, start_row, a, a_row, a_k, b, b_k, b_vector, k)


@reordering_kernel
def multiply(a, right, start, out):
    """out = start + a · right: rows [R, ≥ k], ``panels`` of [k, n], a bias [n], and rows [R, n].

    R is a multiple of TILE_ROWS.
    """
    count, k, _ = right.shape
    panel = 0
    while panel < count:
        whole = panel + TILE_VECTORS <= count
        for row in range(0, a.shape[0], TILE_ROWS):
            _tile(
                whole,
                out.ctypes.data + 4 * (row * out.shape[1] + panel * TILE_COLUMNS), out.shape[1],
                start.ctypes.data + 4 * panel * TILE_COLUMNS, 0,
                a.ctypes.data + 4 * row * a.shape[1], a.shape[1], 1,
                right.ctypes.data + 4 * panel * k * TILE_COLUMNS, TILE_COLUMNS, k * TILE_COLUMNS,
                k,
            )  # fmt: skip
        panel += TILE_VECTORS if whole else 1


@reordering_kernel
def add_product(a, b, out):
    """out += aᵀ · b: rows [R, m] and [R, n], sums [m, n]; the gradient of a layer's weights.

    m is a multiple of TILE_ROWS, n of TILE_COLUMNS.
    """
    column = 0
    while column < b.shape[1]:
        whole = column + TILE_VECTORS * TILE_COLUMNS <= b.shape[1]
        for row in range(0, a.shape[1], TILE_ROWS):
            place = out.ctypes.data + 4 * (row * out.shape[1] + column)
            _tile(
                whole,
                place, out.shape[1],
                place, out.shape[1],
                a.ctypes.data + 4 * row, 1, a.shape[1],
                b.ctypes.data + 4 * column, b.shape[1], TILE_COLUMNS, a.shape[0],
            )  # fmt: skip
        column += TILE_VECTORS * TILE_COLUMNS if whole else TILE_COLUMNS
