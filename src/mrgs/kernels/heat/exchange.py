"""Heat between neighbouring Gaussians: Eq. 11 and 12, by the numbers of ``readout``."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import get_num_threads, prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels.dense import SHARES
from mrgs.kernels.jit import (
    reordering_inner_function,
    reordering_kernel,
    reordering_parallel_kernel,
)
from mrgs.kernels.require import require, require_indices


def exchange(
    projected: Float[Tensor, "n r"],
    opacity: Float[Tensor, " v"],
    constants: Float[Tensor, "3"],
    neighbours: Int64[Tensor, "n k"],
    rows: Int64[Tensor, " v"],
    weights: tuple[float, float],
) -> Float[Tensor, " v"]:
    """Eq. 12 in the direction w of the output layer, w · F' + b, with the flux of Eq. 11.

    Args:
        projected: a_1 · F … a_K · F and w · F of each Gaussian F (see ``readout``).
        opacity: o_t of the anchors.
        constants: w · b_q, v · b_grad and b.
        neighbours: u_1 … u_K of all Gaussians.
        rows: the anchors i.
        weights: w_a and w_s.

    Raises:
        ValueError: tensors of other sizes or types.
        IndexError: neighbours or rows that do not exist.
    """
    count, k = neighbours.shape
    require("projected", projected, (count, k + 1))
    require("opacity", opacity, (len(rows),))
    require("constants", constants, (3,))
    require_indices("neighbours", neighbours, (count, k), count)
    require_indices("rows", rows, (None,), count)
    refined: Tensor = _Exchange.apply(projected, opacity, constants, neighbours, rows, weights)
    return refined


def with_neighbours(
    rows: Int64[Tensor, " v"], neighbours: Int64[Tensor, "n k"]
) -> Int64[Tensor, " m"]:
    """These Gaussians and all their neighbours, each once, in ascending order.

    Raises:
        ValueError: not int64.
        IndexError: neighbours or rows that do not exist.
    """
    count = len(neighbours)
    require_indices("rows", rows, (None,), count)
    require_indices("neighbours", neighbours, (count, None), count)
    return torch.from_numpy(_with_neighbours(rows.numpy(), neighbours.contiguous().numpy()))


@reordering_kernel
def _with_neighbours(rows, neighbours):
    is_needed = np.zeros(neighbours.shape[0], np.bool_)
    for row in rows:
        is_needed[row] = True
        for tap in range(neighbours.shape[1]):
            is_needed[neighbours[row, tap]] = True
    return np.flatnonzero(is_needed)


class _Places(NamedTuple):
    """The anchors, the neighbours of all Gaussians, and w_a and w_s."""

    rows: np.ndarray
    neighbours: np.ndarray
    weights: np.ndarray


class _Exchange(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        *tensors, weights = inputs
        tensors = [tensor.contiguous() for tensor in tensors]
        projected, opacity, constants, neighbours, rows = (
            tensor.detach().numpy() for tensor in tensors
        )
        ctx.weights = np.asarray(weights, np.float32)
        refined, gradient = np.empty_like(opacity), np.empty_like(opacity)
        _forward(
            _Places(rows, neighbours, ctx.weights), projected, opacity, constants, gradient, refined
        )
        ctx.save_for_backward(*tensors[1:], torch.from_numpy(gradient))
        ctx.shape = projected.shape
        return torch.from_numpy(refined)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        opacity, constants, neighbours, rows, gradient = (
            tensor.detach().numpy() for tensor in ctx.saved_tensors
        )
        places, grad = _Places(rows, neighbours, ctx.weights), grads[0].contiguous().numpy()
        grad_projected = np.zeros(ctx.shape, np.float32)
        _backward_neighbours(places, opacity, grad, grad_projected, get_num_threads())
        grad_opacity, sums = np.empty_like(opacity), np.zeros((SHARES, 3), np.float32)
        _backward_anchors(places, opacity, constants, gradient, grad, grad_opacity, sums)
        arrays = (grad_projected, grad_opacity, sums.sum(axis=0))
        return (*(torch.from_numpy(array) for array in arrays), None, None, None)


@reordering_parallel_kernel
def _forward(places, projected, opacity, constants, gradient, refined):
    rows, neighbours, weights = places
    count = neighbours.shape[1]
    for place in prange(rows.size):
        row = rows[place]
        difference, levels = constants[1], np.float32(0)
        for tap in range(count):
            other = neighbours[row, tap]
            difference += projected[other, tap] - projected[row, tap]
            levels += projected[other, count]
        gradient[place] = difference
        flux = constants[0] - opacity[place] * difference
        surrounding = levels / np.float32(count)
        refined[place] = (
            weights[0] * (projected[row, count] + flux) + weights[1] * surrounding + constants[2]
        )


@reordering_parallel_kernel
def _backward_neighbours(places, opacity, grad, grad_projected, parts):
    """The gradient at ``projected``.

    Each thread adds to Gaussians of its own, in the order of the rows: no two threads meet, and the
    order of a sum does not depend on their number.
    """
    for part in prange(parts):
        first = np.int64(part) * grad_projected.shape[0] // parts
        end = (np.int64(part) + 1) * grad_projected.shape[0] // parts
        _add_to_range(places, opacity, grad, grad_projected, first, end)


@reordering_inner_function
def _add_to_range(places, opacity, grad, grad_projected, first, end):
    rows, neighbours, weights = places
    count = neighbours.shape[1]
    for place in range(rows.size):
        row = rows[place]
        slope = -weights[0] * opacity[place] * grad[place]
        surrounding = weights[1] * grad[place] / np.float32(count)
        is_own = first <= row < end
        if is_own:
            grad_projected[row, count] += weights[0] * grad[place]
        for tap in range(count):
            if is_own:
                grad_projected[row, tap] -= slope
            other = neighbours[row, tap]
            if first <= other < end:
                grad_projected[other, tap] += slope
                grad_projected[other, count] += surrounding


@reordering_parallel_kernel
def _backward_anchors(places, opacity, constants, gradient, grad, grad_opacity, sums):
    """The gradients at the opacities, and at the constants: one sum for each share of the
    anchors."""
    anchor_weight = places.weights[0]
    for share in prange(SHARES):
        for place in range(
            np.int64(share) * grad.size // SHARES, (np.int64(share) + 1) * grad.size // SHARES
        ):
            scaled = anchor_weight * grad[place]
            grad_opacity[place] = -scaled * gradient[place]
            sums[share, 0] += scaled
            sums[share, 1] -= scaled * opacity[place]
            sums[share, 2] += grad[place]
