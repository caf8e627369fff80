"""A linear layer over blocks of rows, forward and backward, and the shares that the blocks are
dealt out in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mrgs.kernels.dense.product import (
    BLOCK_ROWS,
    TILE_COLUMNS,
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
