"""A linear layer over blocks of rows, forward and backward; the shares in which threads take the
blocks; small products of the layers' own matrices; memory for what a backward pass needs."""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels.dense.product import (
    BLOCK_ROWS,
    TILE_COLUMNS,
    TILE_ROWS,
    add_product,
    multiply,
    panels,
    rounded_up,
)
from mrgs.kernels.jit import reordering_inner_function

SHARES = 32
"""Parts that the rows are cut into, each with sums of its own, so that no sum depends on the number
of threads."""


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
    """The gradients of a layer, one for each share: [SHARES, outputs, inputs] and [SHARES,
    outputs]."""

    weight: np.ndarray
    bias: np.ndarray


def pack(weight: Tensor, bias: Tensor, back_inputs: int | None = None) -> PackedLayer:
    """A layer of weight [outputs, inputs]; only its first ``back_inputs`` inputs will get a
    gradient."""
    array = weight.detach().numpy()
    back = panels(array[:, :back_inputs])
    widths = rounded_up(len(bias), TILE_COLUMNS), back.shape[0] * TILE_COLUMNS
    return PackedLayer(
        panels(array.T),
        _filled_up(bias.detach().numpy(), widths[0]),
        back,
        np.zeros(widths[1], np.float32),
    )


def _filled_up(vector: np.ndarray, width: int) -> np.ndarray:
    return np.pad(vector, (0, width - len(vector)))


def no_sums(outputs: int, inputs: int) -> Sums:
    """Zeros for a layer whose blocks have this many columns."""
    return Sums(
        np.zeros((SHARES, outputs, inputs), np.float32), np.zeros((SHARES, outputs), np.float32)
    )


def total(sums: Sums, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The gradients of weight and bias."""
    outputs, inputs = weight.shape
    return (
        torch.from_numpy(sums.weight.sum(axis=0)[:outputs, :inputs]),
        torch.from_numpy(sums.bias.sum(axis=0)[:outputs]),
    )


def slots(rows: int, keep: bool) -> int:
    """How many blocks of activations a pass needs: all if they are kept for the backward pass, else
    one per share."""
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
    """Copy a block: the products read it across its rows, which is slow until it is in the
    cache."""
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
    """a · b for float32 on the CPU; a library's product of some shapes depends on the number of
    threads."""
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


class Activations:
    """An array that is not cleared; its memory goes to a later one when this is dropped.

    Fresh memory costs: the system clears each page when it is first touched, which takes as long as
    filling it.

    Attributes:
        array: float32, of the given shape.
    """

    _LARGEST_SPARES = 2
    _spare: ClassVar[list[np.ndarray]] = []

    def __init__(self, *shape: int) -> None:
        size = math.prod(shape)
        fitting = [
            place for place, memory in enumerate(self._spare) if size <= memory.size <= 2 * size
        ]
        self._memory = self._spare.pop(fitting[0]) if fitting else np.empty(size, np.float32)
        self.array = self._memory[:size].reshape(shape)

    def __del__(self) -> None:
        self._spare.append(self._memory)
        self._spare.sort(key=lambda memory: memory.size)
        del self._spare[: -self._LARGEST_SPARES]
