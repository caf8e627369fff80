"""The thermal chain up to the neighbours, and its gradient, block by block: orthogonal extraction
(Eq. 7), PE_p (Eq. 9) and two layers, φ_e (Eq. 8) with the thermal head's first, and the head's last
with the rows of ``readout``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels import dense
from mrgs.kernels.dense import Network, NetworkSums
from mrgs.kernels.jit import (
    reordering_inlined_function,
    reordering_inner_function,
    reordering_parallel_kernel,
)
from mrgs.kernels.require import require, require_indices, require_layers

_SH = 48
_EPSILON = np.float32(1e-8)


def project_features(
    embedding: Float[Tensor, "n c"],
    sh_dc: Float[Tensor, "n 1 3"],
    sh_rest: Float[Tensor, "n 15 3"],
    layers: tuple[Tensor, ...],
    positions: Float[Tensor, "n 3"],
    frequencies: int,
    rows: Int64[Tensor, " v"],
) -> Float[Tensor, "n r"]:
    """What neighbours read of each F_t; only ``rows`` are computed, others are 0. No gradient flows
    to positions. ValueError for tensors of other sizes or types, IndexError for rows that do not
    exist.

    Args:
        embedding: e_m.
        sh_dc: colour coefficients of degree 0.
        sh_rest: colour coefficients of degrees 1 to 3.
        layers: weight and bias of φ_SH [C, 48], of the first layer [H, C + 6 L] and of the second
            [K + 1, H].
        positions: normalised to about [-1, 1].
        frequencies: L of PE_p.
        rows: distinct Gaussians.
    """
    count, width = len(positions), embedding.shape[-1]
    require("embedding", embedding, (count, width))
    require("sh_dc", sh_dc, (count, 1, 3))
    require("sh_rest", sh_rest, (count, _SH // 3 - 1, 3))
    require("positions", positions, (count, 3))
    require_indices("rows", rows, (None,), count)
    require_layers("φ_SH", layers[:2], (_SH, width))
    require_layers("the thermal head", layers[2:], (width + 6 * frequencies, None, None))
    keep = torch.is_grad_enabled()
    projected: Tensor = _Projection.apply(
        embedding, sh_dc, sh_rest, *layers, positions.detach(), frequencies, rows, keep
    )
    return projected


class _Inputs(NamedTuple):
    """Arrays of all Gaussians (or gradients): e_m, the 3 and the other 45 colour coefficients."""

    embedding: np.ndarray
    sh_dc: np.ndarray
    sh_rest: np.ndarray


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        *tensors, positions, frequencies, rows, keep = inputs
        tensors = [tensor.contiguous() for tensor in tensors]
        # Only e_orth, of the width of SH', gets a gradient among the second layer's inputs.
        second = dense.pack(tensors[5], tensors[6], len(tensors[3]))
        network = Network(dense.pack(*tensors[3:5]), second, dense.pack(*tensors[7:]))
        units = network.second.bias.size
        hidden = np.empty((dense.slots(len(rows), keep), dense.BLOCK_ROWS, units), np.float32)
        projected = np.zeros((len(positions), len(tensors[-1])), np.float32)
        positions = positions.contiguous()
        gaussians = _flattened(tensors[:3])
        _forward(
            gaussians, positions.numpy(), rows.numpy(), frequencies, *network, hidden, keep,
            projected,
        )  # fmt: skip
        if keep:
            ctx.save_for_backward(*tensors, positions, rows)
            ctx.frequencies, ctx.network, ctx.hidden = frequencies, network, hidden
        return torch.from_numpy(projected)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *tensors, positions, rows = ctx.saved_tensors
        weights = tensors[3::2]
        sums = dense.no_sums(weights)
        gaussians = _flattened(tensors[:3])
        gradients = _Inputs(*(np.zeros(array.shape, np.float32) for array in gaussians))
        _backward(
            gaussians, positions.numpy(), rows.numpy(), ctx.frequencies, *ctx.network,
            ctx.hidden, grads[0].contiguous().numpy(), *sums, gradients,
        )  # fmt: skip
        of_gaussians = [
            torch.from_numpy(array.reshape(tensor.shape))  # no view, so autograd adds in place
            for array, tensor in zip(gradients, tensors[:3], strict=True)
        ]
        return (*of_gaussians, *dense.totals(sums, weights), None, None, None, None)


def _flattened(tensors: Sequence[Tensor]) -> _Inputs:
    return _Inputs(*(tensor.detach().flatten(1).numpy() for tensor in tensors))


@reordering_parallel_kernel
def _forward(
    gaussians, positions, rows, frequencies, phi_sh, second, output, hidden, keep, projected
):
    for share in prange(dense.SHARES):
        network = Network(phi_sh, second, output)  # here, because prange takes no tuples of tuples
        _forward_share(
            np.int64(share), gaussians, positions, rows, frequencies, network, hidden, keep,
            projected,
        )  # fmt: skip


@reordering_inlined_function
def _forward_share(
    share, gaussians, positions, rows, frequencies, network, hidden, keep, projected
):
    sh, directions, inputs = _scratch(network)
    outputs = np.empty((dense.BLOCK_ROWS, network.output.bias.size), np.float32)
    first, end = dense.blocks_of(share, rows.size)
    for block in range(first, end):
        here = rows[block * dense.BLOCK_ROWS : (block + 1) * dense.BLOCK_ROWS]
        _fill_inputs(gaussians, positions, here, frequencies, network, sh, directions, inputs)
        h = hidden[block if keep else share]
        dense.linear(inputs, network.second, h)
        dense.rectify(h)
        dense.linear(h, network.output, outputs)
        for place in range(here.size):
            for channel in range(projected.shape[1]):
                projected[here[place], channel] = outputs[place, channel]


@reordering_inner_function
def _scratch(network):
    """SH, SH' and e_orth ⊕ PE_p of a block."""
    inputs = dense.rounded_up(network.second.forward.shape[1], dense.TILE_COLUMNS)
    return (
        np.zeros((dense.BLOCK_ROWS, _SH), np.float32),
        np.zeros((dense.BLOCK_ROWS, network.first.bias.size), np.float32),
        np.zeros((dense.BLOCK_ROWS, inputs), np.float32),
    )


@reordering_inlined_function
def _fill_inputs(gaussians, positions, rows, frequencies, network, sh, directions, inputs):
    """e_orth ⊕ PE_p of a block, and on the way SH and SH' = φ_SH(SH)."""
    width = gaussians.embedding.shape[1]
    points = np.empty((rows.size, 3), np.float32)
    for place in range(rows.size):
        row = rows[place]
        for channel in range(3):
            points[place, channel] = positions[row, channel]
            sh[place, channel] = gaussians.sh_dc[row, channel]
        for coefficient in range(_SH - 3):
            sh[place, 3 + coefficient] = gaussians.sh_rest[row, coefficient]
    dense.linear(sh, network.first, directions)
    for place in range(rows.size):
        row = rows[place]
        share, _ = _share_along(gaussians.embedding, row, directions, place)
        for column in range(width):
            inputs[place, column] = (
                gaussians.embedding[row, column] - share * directions[place, column]
            )
    dense.encode(points, frequencies, inputs[:, width:])


@reordering_inner_function
def _share_along(embedding, row, directions, place):
    """(e_m · SH') / (‖SH'‖² + 1e-8) of Eq. 7, and 1 / (‖SH'‖² + 1e-8)."""
    dot, squared_norm = np.float32(0), np.float32(0)
    for column in range(embedding.shape[1]):
        dot += embedding[row, column] * directions[place, column]
        squared_norm += directions[place, column] * directions[place, column]
    inverse = np.float32(1) / (squared_norm + _EPSILON)
    return dot * inverse, inverse


@reordering_parallel_kernel
def _backward(
    gaussians, positions, rows, frequencies, phi_sh, second, output, hidden, grad,
    phi_sh_sums, second_sums, output_sums, gradients,
):  # fmt: skip
    for share in prange(dense.SHARES):
        network = Network(phi_sh, second, output)
        sums = NetworkSums(phi_sh_sums, second_sums, output_sums)
        _backward_share(
            np.int64(share), gaussians, positions, rows, frequencies, network, hidden, grad, sums,
            gradients
        )  # fmt: skip


@reordering_inlined_function
def _backward_share(
    share, gaussians, positions, rows, frequencies, network, hidden, grad, sums, gradients
):
    sh, directions, inputs = _scratch(network)
    g_outputs = np.zeros((dense.BLOCK_ROWS, sums.output.bias.shape[1]), np.float32)
    h = np.empty((dense.BLOCK_ROWS, hidden.shape[2]), np.float32)
    g_hidden = np.empty_like(h)
    g_directions, g_sh = np.empty_like(directions), np.empty_like(sh)
    first, end = dense.blocks_of(share, rows.size)
    for block in range(first, end):
        here = rows[block * dense.BLOCK_ROWS : (block + 1) * dense.BLOCK_ROWS]
        _fill_inputs(gaussians, positions, here, frequencies, network, sh, directions, inputs)
        g_outputs[here.size :] = 0
        for place in range(here.size):
            for channel in range(grad.shape[1]):
                g_outputs[place, channel] = grad[here[place], channel]
        dense.read_in_order(hidden[block], h)
        dense.linear_backward(g_outputs, h, network.output, sums.output, share, g_hidden)
        dense.rectify_backward(g_hidden, h)
        dense.linear_backward(g_hidden, inputs, network.second, sums.second, share, g_directions)
        _reject_backward(gaussians.embedding, here, directions, g_directions, gradients.embedding)
        dense.linear_backward(g_directions, sh, network.first, sums.first, share, g_sh)
        for place in range(here.size):
            row = here[place]
            for channel in range(3):
                gradients.sh_dc[row, channel] = g_sh[place, channel]
            for coefficient in range(_SH - 3):
                gradients.sh_rest[row, coefficient] = g_sh[place, 3 + coefficient]


@reordering_inlined_function
def _reject_backward(embedding, rows, directions, grad, grad_embedding):
    """The gradient of Eq. 7: at e_orth in ``grad``, which becomes that at SH'."""
    two = np.float32(2)
    for place in range(rows.size):
        row = rows[place]
        share, inverse = _share_along(embedding, row, directions, place)
        along = np.float32(0)
        for column in range(embedding.shape[1]):
            along += grad[place, column] * directions[place, column]
        along *= inverse
        for column in range(embedding.shape[1]):
            g, direction = grad[place, column], directions[place, column]
            grad_embedding[row, column] = g - along * direction
            grad[place, column] = (
                along * (two * share * direction - embedding[row, column]) - share * g
            )
