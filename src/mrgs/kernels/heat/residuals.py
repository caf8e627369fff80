"""t̂ without F': behind F_t everything is linear but for the factor o_t, so the output row w is
carried through the layers instead of the features.

With v = f_qᵀ w and a_k = f_grad,kᵀ v,

    w · q_i = w · b_q − o_t,i · (Σ_k a_k · (F_{u_k} − F_i) + v · b_grad)

and a Gaussian passes K + 1 numbers to its neighbours (a_k · F and w · F) where Eq. 11 passes K
vectors: Eq. 11 and 12 in the direction of w. On the CPU a fused pass computes the features; on a
GPU torch's own kernels do. The products of weights are given as a function, because the CPU has one
of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import get_num_threads, prange
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mrgs.field import RadianceField
from mrgs.field.encoding import take
from mrgs.field.heat import FourierHeatTransformation
from mrgs.field.spherical_harmonics import MAX_DEGREE, up_to_degree
from mrgs.kernels.dense import SHARES, product
from mrgs.kernels.heat.thermal_head import project_features
from mrgs.kernels.jit import reordering_inner_function, reordering_parallel_kernel
from mrgs.kernels.require import listed, require, require_indices
from mrgs.scene import RGB, THERMAL, Gaussians


def residuals_on_cpu(
    field: RadianceField,
    gaussians: Gaussians,
    neighbours: Int64[Tensor, "n k"] | None,
    rows: Int64[Tensor, " v"] | None = None,
    color_degree: int = MAX_DEGREE,
) -> Float[Tensor, "v 1"]:
    """``RadianceField.temperature_residuals`` for float32 on the CPU."""
    neighbours = field.checked_neighbours(neighbours, len(gaussians))
    needed = None if rows is None else with_neighbours(rows, neighbours)
    projected = _projected_features(field, gaussians, listed(needed, len(gaussians)), color_degree)
    opacity = take(gaussians.opacity(THERMAL), rows)
    anchors = listed(rows, len(gaussians))
    heat, output = field.heat, field.temperature_output
    if heat.k == 0:
        return field.config.temperature_scale * (projected.index_select(0, anchors) + output.bias)
    constants = readout_constants(heat, output, product)
    weights = (heat.anchor_weight, heat.surrounding_weight)
    refined = exchange(projected, opacity, constants, neighbours, anchors, weights)
    return field.config.temperature_scale * refined[:, None]


def _projected_features(
    field: RadianceField, gaussians: Gaussians, rows: Int64[Tensor, " m"], color_degree: int
) -> Float[Tensor, "n r"]:
    """The product of some F_t with the read-out's rows; 0 for the other Gaussians."""
    layers = _merged_layers(field, readout_rows(field.heat, field.temperature_output, product))
    phi_sh = field.extraction.phi_sh
    return project_features(
        gaussians.embedding,
        gaussians.sh_dc[RGB],
        up_to_degree(gaussians.sh_rest[RGB], color_degree),
        (phi_sh.weight, phi_sh.bias, *layers),
        field.normalised(gaussians.means.detach()),
        field.thermal_head.frequencies,
        rows,
    )


def _merged_layers(
    field: RadianceField, rows: Float[Tensor, "r f"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weight and bias of two layers around the thermal head's ReLU, each the product of two linear
    layers.

    φ_e of Eq. 8 goes into the first, W (φ_e(x) ⊕ PE_p) = W_e φ_e x + W_e b_e + W_p PE_p; the
    read-out into the second. Both biases pass through the product as one more column.
    """
    phi_e = field.extraction.phi_e
    hidden, last = (layer for layer in field.thermal_head.mlp if isinstance(layer, nn.Linear))
    of_e_t, of_position = hidden.weight.tensor_split([len(phi_e.weight)], dim=1)
    first = product(of_e_t, torch.cat([phi_e.weight, phi_e.bias[:, None]], dim=1))
    second = product(rows, torch.cat([last.weight, last.bias[:, None]], dim=1))
    return (
        torch.cat([first[:, :-1], of_position], dim=1),
        first[:, -1] + hidden.bias,
        second[:, :-1],
        second[:, -1],
    )


def residuals_on_gpu(
    field: RadianceField,
    gaussians: Gaussians,
    neighbours: Int64[Tensor, "n k"] | None,
    rows: Int64[Tensor, " v"] | None = None,
    color_degree: int = MAX_DEGREE,
) -> Float[Tensor, "v 1"]:
    """``RadianceField.temperature_residuals`` for float32 on a GPU, from the features of all
    Gaussians: to learn how many are needed, the host would have to wait for the device."""
    neighbours = field.checked_neighbours(neighbours, len(gaussians))
    heat, output, scale = field.heat, field.temperature_output, field.config.temperature_scale
    rest = up_to_degree(gaussians.sh_rest[RGB], color_degree)
    e_t = field.extraction(gaussians.embedding, torch.cat([gaussians.sh_dc[RGB], rest], dim=1))
    features = field.thermal_head(e_t, field.normalised(gaussians.means))
    projected = features @ readout_rows(heat, output, torch.matmul).T
    if heat.k == 0:
        return scale * (take(projected, rows) + output.bias)
    refined = _exchange_in_torch(
        projected,
        take(gaussians.opacity(THERMAL), rows),
        readout_constants(heat, output, torch.matmul),
        take(neighbours, rows),
        take(projected, rows),
        (heat.anchor_weight, heat.surrounding_weight),
    )
    return scale * refined[:, None]


def _exchange_in_torch(
    projected: Float[Tensor, "n r"],
    opacity: Float[Tensor, " v"],
    constants: Float[Tensor, "3"],
    neighbours: Int64[Tensor, "v k"],
    anchors: Float[Tensor, "v r"],
    weights: tuple[float, float],
) -> Float[Tensor, " v"]:
    """``exchange`` in torch, with the anchors' rows already taken."""
    slope, level = projected[:, :-1], projected[:, -1]
    gradient = (slope.gather(0, neighbours) - anchors[:, :-1]).sum(dim=1)
    flux = constants[0] - opacity * (gradient + constants[1])
    # The gradient is added atomically: its last bits differ from run to run.
    surrounding = level.index_select(0, neighbours.flatten()).unflatten(0, neighbours.shape)
    return (
        weights[0] * (anchors[:, -1] + flux) + weights[1] * surrounding.mean(dim=1) + constants[2]
    )


Product: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""a · b of two matrices."""


def readout_rows(
    heat: FourierHeatTransformation, output: nn.Linear, product: Product
) -> Float[Tensor, "r c"]:
    """a_1 … a_K and w, as rows: what an anchor reads of its neighbours' features and of its own.
    The output layer behind F' has one channel; ``product`` is that of two matrices."""
    w = output.weight
    if heat.k == 0:
        return w
    v = product(w, heat.f_q.weight[:, :, 0])
    taps = product(v, heat.f_grad.weight.flatten(1)).view(-1, heat.k)
    return torch.cat([taps.T, w])


def readout_constants(
    heat: FourierHeatTransformation, output: nn.Linear, product: Product
) -> Float[Tensor, "3"]:
    """w · b_q, v · b_grad and the output's bias; the arguments are those of ``readout_rows``."""
    w = output.weight
    v = product(w, heat.f_q.weight[:, :, 0])
    return torch.stack(
        [(w * _bias(heat.f_q)).sum(), (v * _bias(heat.f_grad)).sum(), output.bias[0]]
    )


def _bias(layer: nn.Conv1d) -> Tensor:
    assert layer.bias is not None
    return layer.bias


def exchange(
    projected: Float[Tensor, "n r"],
    opacity: Float[Tensor, " v"],
    constants: Float[Tensor, "3"],
    neighbours: Int64[Tensor, "n k"],
    rows: Int64[Tensor, " v"],
    weights: tuple[float, float],
) -> Float[Tensor, " v"]:
    """Eq. 12 in the direction w of the output layer, w · F' + b, with the flux of Eq. 11.
    ValueError for tensors of other sizes or types, IndexError for neighbours or rows that do not
    exist.

    Args:
        projected: a_1 · F … a_K · F and w · F of each Gaussian F (see ``readout_rows``).
        opacity: o_t of the anchors.
        constants: w · b_q, v · b_grad and b.
        neighbours: u_1 … u_K of all Gaussians.
        rows: the anchors i.
        weights: w_a and w_s.
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
    """These Gaussians and all their neighbours, each once, in ascending order. ValueError if they
    are not int64, IndexError for neighbours or rows that do not exist."""
    count = len(neighbours)
    require_indices("rows", rows, (None,), count)
    require_indices("neighbours", neighbours, (count, None), count)
    is_needed, chosen = np.zeros(count, np.bool_), rows.numpy()
    is_needed[chosen] = True
    is_needed[neighbours.numpy().take(chosen, axis=0).ravel()] = True
    return torch.from_numpy(np.flatnonzero(is_needed))


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
    """The gradient at ``projected``. Each thread adds to Gaussians of its own, in the order of the
    rows, so that sums do not depend on the number of threads."""
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
    """The gradients at the opacities and at the constants: one sum for each share of anchors."""
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
