"""The colour residual ĉ and its gradient: directions, PE_v and ``ColorHead``, block by block."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import prange
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mrgs.field.appearance import ColorHead
from mrgs.kernels import dense
from mrgs.kernels.dense import Network, NetworkSums
from mrgs.kernels.harmonics.cpu import add_direction_gradient, direction
from mrgs.kernels.jit import reordering_inlined_function, reordering_parallel_kernel
from mrgs.kernels.require import listed, require, require_layers


def color_residuals(
    head: ColorHead,
    embedding: Float[Tensor, "n c"],
    means: Float[Tensor, "n 3"],
    camera_position: Float[Tensor, "3"],
    rows: Int64[Tensor, " v"] | None = None,
) -> Float[Tensor, "v 3"]:
    """``mrgs.field.appearance.color_residuals`` for float32 on the CPU. ValueError for tensors of
    other sizes or types, IndexError for rows that do not exist."""
    *hidden, output = (layer for layer in head.mlp if isinstance(layer, nn.Linear))
    weights = [tensor for layer in hidden for tensor in (layer.weight, layer.bias)]
    weights += [head.scale * output.weight, head.scale * output.bias]
    width = embedding.shape[-1]
    require("embedding", embedding, (len(means), width))
    require("means", means, (None, 3))
    require("camera_position", camera_position, (3,))
    units = len(hidden[0].weight)
    require_layers("the colour head", weights, (width + 6 * head.frequencies, units, units, 3))
    keep = torch.is_grad_enabled()
    residuals: Tensor = _ColorResidual.apply(
        embedding, means, camera_position, *weights, head.frequencies,
        listed(rows, len(means)), keep,
    )  # fmt: skip
    return residuals


class _Inputs(NamedTuple):
    """Arrays of all Gaussians (or their gradients); camera: its position."""

    embedding: np.ndarray
    means: np.ndarray
    camera: np.ndarray


class _ColorResidual(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        *tensors, frequencies, rows, keep = inputs
        tensors = [tensor.contiguous() for tensor in tensors]
        units = dense.rounded_up(len(tensors[4]), dense.TILE_COLUMNS)
        hidden = np.empty((dense.slots(len(rows), keep), 2, dense.BLOCK_ROWS, units), np.float32)
        residual = np.empty((len(rows), 3), np.float32)
        gaussians = _Inputs(*(tensor.detach().numpy() for tensor in tensors[:3]))
        network = Network(*(dense.pack(*tensors[place : place + 2]) for place in (3, 5, 7)))
        _forward(gaussians, rows.numpy(), frequencies, *network, hidden, keep, residual)
        if keep:
            ctx.save_for_backward(*tensors, rows)
            ctx.frequencies, ctx.network, ctx.hidden = frequencies, network, hidden
        return torch.from_numpy(residual)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *tensors, rows = ctx.saved_tensors
        weights = tensors[3::2]
        sums = dense.no_sums(weights)
        gaussians = _Inputs(*(tensor.detach().numpy() for tensor in tensors[:3]))
        gradients = _Inputs(*(np.zeros(array.shape, np.float32) for array in gaussians))
        _backward(
            gaussians, rows.numpy(), ctx.frequencies, *ctx.network, ctx.hidden,
            grads[0].contiguous().numpy(), *sums, gradients,
        )  # fmt: skip
        if ctx.needs_input_grad[2]:
            gradients.camera[:] = -gradients.means.sum(axis=0)
        of_inputs = (torch.from_numpy(array) for array in gradients)
        return (*of_inputs, *dense.totals(sums, weights), None, None, None)


@reordering_parallel_kernel
def _forward(gaussians, rows, frequencies, first, second, output, hidden, keep, residual):
    for share in prange(dense.SHARES):
        network = Network(first, second, output)  # here, because prange takes no tuples of tuples
        _forward_share(
            np.int64(share), gaussians, rows, frequencies, network, hidden, keep, residual
        )


@reordering_inlined_function
def _forward_share(share, gaussians, rows, frequencies, network, hidden, keep, residual):
    inputs = np.zeros((dense.BLOCK_ROWS, network.first.no_bias.size), np.float32)
    outputs = np.empty((dense.BLOCK_ROWS, network.output.bias.size), np.float32)
    first, end = dense.blocks_of(share, rows.size)
    for block in range(first, end):
        start = block * dense.BLOCK_ROWS
        here = rows[start : start + dense.BLOCK_ROWS]
        _fill_inputs(gaussians, here, frequencies, inputs)
        slot = block if keep else share
        h1, h2 = hidden[slot, 0], hidden[slot, 1]
        dense.linear(inputs, network.first, h1)
        dense.rectify(h1)
        dense.linear(h1, network.second, h2)
        dense.rectify(h2)
        dense.linear(h2, network.output, outputs)
        for place in range(here.size):
            for channel in range(3):
                residual[start + place, channel] = outputs[place, channel]


@reordering_inlined_function
def _fill_inputs(gaussians, rows, frequencies, inputs):
    """e_m ⊕ PE_v of a block."""
    width = gaussians.embedding.shape[1]
    directions = np.empty((rows.size, 3), np.float32)
    for place in range(rows.size):
        row = rows[place]
        for column in range(width):
            inputs[place, column] = gaussians.embedding[row, column]
        x, y, z, _ = direction(gaussians.means, gaussians.camera, row)
        directions[place, 0], directions[place, 1], directions[place, 2] = x, y, z
    dense.encode(directions, frequencies, inputs[:, width:])


@reordering_parallel_kernel
def _backward(
    gaussians, rows, frequencies, first, second, output, hidden, grad,
    first_sums, second_sums, output_sums, gradients,
):  # fmt: skip
    for share in prange(dense.SHARES):
        network = Network(first, second, output)
        sums = NetworkSums(first_sums, second_sums, output_sums)
        _backward_share(
            np.int64(share), gaussians, rows, frequencies, network, hidden, grad, sums, gradients
        )


@reordering_inlined_function
def _backward_share(share, gaussians, rows, frequencies, network, hidden, grad, sums, gradients):
    units = hidden.shape[3]
    inputs = np.zeros((dense.BLOCK_ROWS, network.first.no_bias.size), np.float32)
    g_outputs = np.zeros((dense.BLOCK_ROWS, dense.TILE_ROWS), np.float32)
    h1 = np.empty((dense.BLOCK_ROWS, units), np.float32)
    h2, g1, g2 = np.empty_like(h1), np.empty_like(h1), np.empty_like(h1)
    g_inputs = np.empty_like(inputs)
    first, end = dense.blocks_of(share, rows.size)
    for block in range(first, end):
        start = block * dense.BLOCK_ROWS
        here = rows[start : start + dense.BLOCK_ROWS]
        _fill_inputs(gaussians, here, frequencies, inputs)
        g_outputs[here.size :] = 0
        for place in range(here.size):
            for channel in range(3):
                g_outputs[place, channel] = grad[start + place, channel]
        dense.read_in_order(hidden[block, 0], h1)
        dense.read_in_order(hidden[block, 1], h2)
        dense.linear_backward(g_outputs, h2, network.output, sums.output, share, g2)
        dense.rectify_backward(g2, h2)
        dense.linear_backward(g2, h1, network.second, sums.second, share, g1)
        dense.rectify_backward(g1, h1)
        dense.linear_backward(g1, inputs, network.first, sums.first, share, g_inputs)
        _spread_inputs(gaussians, here, frequencies, inputs, g_inputs, gradients)


@reordering_inlined_function
def _spread_inputs(gaussians, rows, frequencies, inputs, g_inputs, gradients):
    """The gradient of ``_fill_inputs``."""
    width = gaussians.embedding.shape[1]
    toward = np.empty(3, np.float32)
    for place in range(rows.size):
        row = rows[place]
        for column in range(width):
            gradients.embedding[row, column] = g_inputs[place, column]
        x, y, z, inverse = direction(gaussians.means, gaussians.camera, row)
        toward[:] = 0
        dense.encode_backward(inputs, g_inputs, place, width, frequencies, toward)
        add_direction_gradient(x, y, z, inverse, toward, gradients.means, row)
