"""A perceptron with one hidden layer as one kernel: each block of rows stays in the cache."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels import dense
from mrgs.kernels.jit import inner_function, parallel_kernel
from mrgs.kernels.require import require, require_layers


def perceptron(
    inputs: Float[Tensor, "n i"],
    hidden_weight: Float[Tensor, "h i"],
    hidden_bias: Float[Tensor, " h"],
    output_weight: Float[Tensor, "o h"],
    output_bias: Float[Tensor, " o"],
) -> Float[Tensor, "n o"]:
    """``mrgs_thermonerf.networks.perceptron`` for float32 on the CPU. ValueError for
    tensors of other sizes or types."""
    require("inputs", inputs, (None, None))
    layers = (hidden_weight, hidden_bias, output_weight, output_bias)
    require_layers("the perceptron", layers, (inputs.shape[1], None, None))
    outputs: Tensor = _Perceptron.apply(
        inputs, hidden_weight, hidden_bias, output_weight, output_bias
    )
    return outputs


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        inputs, *weights = (tensor.detach().contiguous() for tensor in tensors)
        ctx.save_for_backward(inputs, *weights)
        outputs = inputs.new_empty(len(inputs), len(weights[3]))
        hidden, output = dense.pack(weights[0], weights[1]), dense.pack(weights[2], weights[3])
        _forward(inputs.numpy(), hidden, output, outputs.numpy())
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, ...]:
        inputs, *weights = ctx.saved_tensors
        sums = dense.no_sums(weights[::2])
        grad_inputs = torch.empty_like(inputs)
        hidden, output = dense.pack(weights[0], weights[1]), dense.pack(weights[2], weights[3])
        grad = grads[0].contiguous().numpy()
        _backward(inputs.numpy(), hidden, output, grad, *sums, grad_inputs.numpy())
        return grad_inputs, *dense.totals(sums, weights[::2])


@inner_function
def _copy_rows(source, start, block):
    """A block of rows into the columns of a wider array; rows behind the last are zero."""
    rows = min(dense.BLOCK_ROWS, source.shape[0] - start)
    for row in range(rows):
        for column in range(source.shape[1]):
            block[row, column] = source[start + row, column]
    block[rows:] = 0
    return rows


@inner_function
def _write_rows(block, rows, start, out):
    """The first rows and columns of a block to their place."""
    for row in range(rows):
        for column in range(out.shape[1]):
            out[start + row, column] = block[row, column]


@parallel_kernel
def _forward(inputs, hidden_layer, output_layer, outputs):
    for share in prange(dense.SHARES):
        _forward_share(np.int64(share), inputs, hidden_layer, output_layer, outputs)


@inner_function
def _forward_share(share, inputs, hidden_layer, output_layer, outputs):
    x = np.zeros((dense.BLOCK_ROWS, inputs.shape[1]), np.float32)
    h = np.empty((dense.BLOCK_ROWS, hidden_layer.bias.size), np.float32)
    y = np.empty((dense.BLOCK_ROWS, output_layer.bias.size), np.float32)
    first, end = dense.blocks_of(share, len(inputs))
    for block in range(first, end):
        start = block * dense.BLOCK_ROWS
        rows = _copy_rows(inputs, start, x)
        dense.linear(x, hidden_layer, h)
        dense.rectify(h)
        dense.linear(h, output_layer, y)
        _write_rows(y, rows, start, outputs)


@parallel_kernel
def _backward(inputs, hidden_layer, output_layer, grad, hidden_sums, output_sums, grad_inputs):
    for share in prange(dense.SHARES):
        _backward_share(
            np.int64(share), inputs, hidden_layer, output_layer, grad, hidden_sums, output_sums,
            grad_inputs,
        )  # fmt: skip


@inner_function
def _backward_share(
    share, inputs, hidden_layer, output_layer, grad, hidden_sums, output_sums, grad_inputs
):
    """The hidden values are recomputed, which costs less than keeping them."""
    units = hidden_layer.bias.size
    x = np.zeros((dense.BLOCK_ROWS, hidden_layer.no_bias.size), np.float32)
    h = np.empty((dense.BLOCK_ROWS, units), np.float32)
    g_x, g_h = np.empty_like(x), np.empty_like(h)
    g_y = np.zeros((dense.BLOCK_ROWS, output_sums.bias.shape[1]), np.float32)
    first, end = dense.blocks_of(share, len(inputs))
    for block in range(first, end):
        start = block * dense.BLOCK_ROWS
        rows = _copy_rows(inputs, start, x)
        dense.linear(x, hidden_layer, h)
        dense.rectify(h)
        _copy_rows(grad, start, g_y)
        dense.linear_backward(g_y, h, output_layer, output_sums, share, g_h)
        dense.rectify_backward(g_h, h)
        dense.linear_backward(g_h, x, hidden_layer, hidden_sums, share, g_x)
        _write_rows(g_x, rows, start, grad_inputs)
