"""Matrix products of one block of rows, the linear layers of the heads made from them, and the
positional encoding that the heads begin with.

A library's product starts its threads for each call, and may sum in another order when their
number changes. Here each thread multiplies blocks of its own, small enough to stay in the cache, so
that a whole network passes over a block without leaving it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels.jit import reordering_inner_function, reordering_kernel
from mrgs.kernels.simd import F32, FUSE, LANES, VECTOR, in_all_lanes

TILE_COLUMNS = LANES
"""Columns of a vector of sums, and of a panel."""

TILE_ROWS, TILE_VECTORS = (8, 2) if binding.get_host_cpu_features().get("avx512f") else (4, 1)
"""A tile of 4 × 16 sums takes 8 of the 16 registers of AVX2, one of 8 × 32 16 of the 32 of AVX-512:
enough sums at once that none waits for its own last addition, and each value that is loaded is used
several times. The order in which a sum is added up, and so its bits, are the same in any tile."""

BLOCK_ROWS = 32
"""Rows that pass through a network together; a multiple of TILE_ROWS."""

SHARES = 32
"""Parts of the rows, each with sums of its own: no sum depends on the number of threads."""

_I64 = ir.IntType(64)

# sin(πt) / t on [-1/2, 1/2] as a polynomial in t², fitted at the Chebyshev nodes: error 3e-11
# before rounding.
_SINE = tuple(
    np.float32(c)
    for c in (3.141592654, -5.167712765, 2.550163319, -0.5992521978, 0.08205040173, -0.007028386281)
)
_PI = np.float32(math.pi)
_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1), np.float32(2)


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
            row_start = builder.ptrtoint(at(base, row_stride, row, VECTOR), _I64)
            return at(row_start, ir.Constant(_I64, TILE_COLUMNS), vector, VECTOR)

        places = [(row, vector) for row in range(TILE_ROWS) for vector in range(vectors)]
        sums = {place: cgutils.alloca_once(builder, VECTOR) for place in places}
        for place in places:
            first = builder.load(vector_at(start, start_row, *place), align=4)
            builder.store(first, sums[place])
        with cgutils.for_range(builder, k) as loop:
            row_of_b = builder.ptrtoint(at(b, b_k, loop.index, VECTOR), _I64)
            loaded = [
                builder.load(at(row_of_b, b_vector, vector, VECTOR), align=4)
                for vector in range(vectors)
            ]
            column = builder.ptrtoint(at(a, a_k, loop.index, F32), _I64)
            factors = [
                in_all_lanes(builder, builder.load(at(column, a_row, row, F32)))
                for row in range(TILE_ROWS)
            ]
            for row, vector in places:
                product = builder.fmul(factors[row], loaded[vector], flags=FUSE)
                so_far = builder.load(sums[row, vector])
                builder.store(builder.fadd(so_far, product, flags=FUSE), sums[row, vector])
        for place in places:
            builder.store(builder.load(sums[place]), vector_at(out, out_row, *place), align=4)
        return context.get_dummy_value()

    @intrinsic
    def tile(typingctx, out, out_row, start, start_row, a, a_row, a_k, b, b_k, b_vector, k):
        return types.void(*[types.int64] * 11), codegen

    return tile


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
    """out = start + a · right: rows [R, ≥ k], ``panels`` of [k, n], a bias [n], and rows [R, n]; R
    is a multiple of TILE_ROWS."""
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
    """out += aᵀ · b: rows [R, m] and [R, n], sums [m, n]; the gradient of a layer's weights. m is a
    multiple of TILE_ROWS, n of TILE_COLUMNS."""
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


class PackedLayer(NamedTuple):
    """Weight and bias as ``multiply`` takes them.

    Attributes:
        forward: ``panels`` of weightᵀ.
        bias: filled up with zeros to whole tiles.
        back: ``panels`` of the weight, for the gradient of the inputs; or of its first columns
            only.
        no_bias: zeros, where ``back`` takes a bias.
    """

    forward: np.ndarray
    bias: np.ndarray
    back: np.ndarray
    no_bias: np.ndarray


class Sums(NamedTuple):
    """The gradients of a layer for each share: [SHARES, outputs, inputs] and [SHARES, outputs]."""

    weight: np.ndarray
    bias: np.ndarray


def pack(weight: Tensor, bias: Tensor, back_inputs: int | None = None) -> PackedLayer:
    """A layer of weight [outputs, inputs]; the first ``back_inputs`` inputs will get a gradient."""
    array = weight.detach().numpy()
    back = panels(array[:, :back_inputs])
    filled_up = np.pad(bias.detach().numpy(), (0, -len(bias) % TILE_COLUMNS))
    no_bias = np.zeros(back.shape[0] * TILE_COLUMNS, np.float32)
    return PackedLayer(panels(array.T), filled_up, back, no_bias)


class Network(NamedTuple):
    """Three layers in a row."""

    first: PackedLayer
    second: PackedLayer
    output: PackedLayer


class NetworkSums(NamedTuple):
    """The gradients of a network."""

    first: Sums
    second: Sums
    output: Sums


def no_sums(weights: Sequence[Tensor]) -> list[Sums]:
    """Zeros for the layers of a network, the last of which passes its rows on in no other."""
    units = [TILE_COLUMNS] * (len(weights) - 1) + [TILE_ROWS]
    sizes = [
        (rounded_up(len(weight), unit), rounded_up(weight.shape[1], TILE_COLUMNS))
        for weight, unit in zip(weights, units, strict=True)
    ]
    return [
        Sums(np.zeros((SHARES, *size), np.float32), np.zeros((SHARES, size[0]), np.float32))
        for size in sizes
    ]


def totals(sums: Sequence[Sums], weights: Sequence[Tensor]) -> list[Tensor]:
    """The gradients of weight and bias, layer by layer."""
    found: list[np.ndarray] = []
    for each, weight in zip(sums, weights, strict=True):
        outputs, inputs = weight.shape
        found += [each.weight.sum(axis=0)[:outputs, :inputs], each.bias.sum(axis=0)[:outputs]]
    return [torch.from_numpy(array) for array in found]


def slots(rows: int, keep: bool) -> int:
    """Blocks of activations that a pass needs: all for the backward pass, else one a share."""
    return -(-rows // BLOCK_ROWS) if keep else SHARES


@reordering_inner_function
def blocks_of(share, rows):
    """First block of this share and of the next; ``rows`` is their number over all shares."""
    blocks = (rows + BLOCK_ROWS - 1) // BLOCK_ROWS
    return share * blocks // SHARES, (share + 1) * blocks // SHARES


@reordering_inner_function
def linear(inputs, layer, out):
    """out = inputs · weightᵀ + bias."""
    multiply(inputs, layer.forward, layer.bias, out)


@reordering_inner_function
def linear_backward(grad, inputs, layer, sums, share, grad_inputs):
    """Add to the share's sums, and set the gradient of the inputs."""
    add_product(grad, inputs, sums.weight[share])
    bias = sums.bias[share]
    for row in range(grad.shape[0]):
        for column in range(grad.shape[1]):
            bias[column] += grad[row, column]
    multiply(grad, layer.back, layer.no_bias, grad_inputs)


@reordering_inner_function
def read_in_order(kept, values):
    """Copy a block: the products read it across its rows, which is slow outside of the cache."""
    for row in range(kept.shape[0]):
        for column in range(kept.shape[1]):
            values[row, column] = kept[row, column]


@reordering_inner_function
def rectify(values):
    """ReLU, in place; NaN stays."""
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            if values[row, column] < 0:
                values[row, column] = 0


@reordering_inner_function
def rectify_backward(grad, values):
    """Drop the gradient where the rectified values are 0, in place."""
    for row in range(grad.shape[0]):
        for column in range(grad.shape[1]):
            if values[row, column] <= 0:
                grad[row, column] = 0


def product(a: Float[Tensor, "m k"], b: Float[Tensor, "k n"]) -> Float[Tensor, "m n"]:
    """a · b for float32 on the CPU; a library's product may depend on the number of threads."""
    result: Tensor = _Product.apply(a, b)
    return result


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        ctx.save_for_backward(a, b)
        return _multiplied(a, b)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        a, b = ctx.saved_tensors
        return _multiplied(grads[0], b.T), _multiplied(a.T, grads[0])


def _multiplied(a: Tensor, b: Tensor) -> Tensor:
    (rows, k), columns = a.shape, b.shape[1]
    left = np.zeros((rounded_up(rows, TILE_ROWS), k), np.float32)
    left[:rows] = a.detach().numpy()
    width = rounded_up(columns, TILE_COLUMNS)
    out = np.empty((len(left), width), np.float32)
    multiply(left, panels(b.detach().numpy()), np.zeros(width, np.float32), out)
    return torch.from_numpy(out[:rows, :columns].copy())


@reordering_kernel
def encode(x, frequencies, out):
    """PE(x) of points [R, 3] -> [R, 6 L]: for each n the sines of 2ⁿπx, then the cosines. The sines
    are listed first, so that the compiler can compute many at once."""
    width = 3 * frequencies
    half_turns = np.empty(x.shape[0] * width, np.float32)
    for row in range(x.shape[0]):
        factor = _ONE
        for n in range(frequencies):
            for axis in range(3):
                half_turns[row * width + 3 * n + axis] = factor * x[row, axis]
            factor *= _TWO
    sines, cosines = np.empty_like(half_turns), np.empty_like(half_turns)
    for place in range(half_turns.size):
        sines[place], cosines[place] = _sine_and_cosine(half_turns[place])
    for row in range(x.shape[0]):
        for n in range(frequencies):
            for axis in range(3):
                out[row, 6 * n + axis] = sines[row * width + 3 * n + axis]
                out[row, 6 * n + 3 + axis] = cosines[row * width + 3 * n + axis]


@reordering_kernel
def encode_backward(encoded, grad, row, start, frequencies, grad_x):
    """Add the gradient at one point x to ``grad_x`` [3]: sin' = 2ⁿπ cos, cos' = −2ⁿπ sin. PE(x) and
    its gradient are in a row of ``encoded`` and ``grad``, from the column ``start``."""
    factor = _PI
    for n in range(frequencies):
        for axis in range(3):
            sine, cosine = start + 6 * n + axis, start + 6 * n + 3 + axis
            grad_x[axis] += factor * (
                grad[row, sine] * encoded[row, cosine] - grad[row, cosine] * encoded[row, sine]
            )
        factor *= _TWO


@reordering_inner_function
def _sine_and_cosine(half_turns):
    """sin(πy) and cos(πy) within 3e-7 for any y: y − round(y) is exact, the product πy is not."""
    whole = np.rint(half_turns)
    t = half_turns - whole
    sign = _ONE - _TWO * abs(whole - _TWO * np.rint(_HALF * whole))
    return sign * _sine(t), sign * _sine(_HALF - abs(t))


@reordering_inner_function
def _sine(t):
    s = t * t
    return t * (
        _SINE[0] + s * (_SINE[1] + s * (_SINE[2] + s * (_SINE[3] + s * (_SINE[4] + s * _SINE[5]))))
    )
