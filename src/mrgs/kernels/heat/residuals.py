"""t̂ without F': behind F_t everything is linear but for the factor o_t, so the output row w is
carried through the layers instead of the features.

With v = f_qᵀ w and a_k = f_grad,kᵀ v,

    w · q_i = w · b_q − o_t,i · (Σ_k a_k · (F_{u_k} − F_i) + v · b_grad)

and a Gaussian passes K + 1 numbers to its neighbours (a_k · F and w · F) where Eq. 11 passes K
vectors. On the CPU a fused pass computes the features; on a GPU torch's own kernels do. The
products of weights are given as a function, because the CPU has one of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from mrgs.field import RadianceField
from mrgs.field.encoding import take
from mrgs.field.heat import FourierHeatTransformation
from mrgs.field.spherical_harmonics import MAX_DEGREE, up_to_degree
from mrgs.kernels.dense import product
from mrgs.kernels.heat.exchange import exchange, with_neighbours
from mrgs.kernels.heat.thermal_head import project_features
from mrgs.kernels.require import listed
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
    needed = rows
    if rows is not None:
        needed = with_neighbours(rows, neighbours)
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
    """``RadianceField.temperature_residuals`` for float32 on a GPU.

    It computes the features of all Gaussians: to learn how many are needed, the host would have to
    wait for the device.
    """
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
    """``mrgs.kernels.heat.exchange.exchange`` in torch, with the anchors' rows already taken."""
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

    Args:
        heat: of C channels.
        output: the layer behind F', of one channel.
        product: of two matrices.
    """
    w = output.weight
    if heat.k == 0:
        return w
    taps = product(_through_f_q(heat, w, product), heat.f_grad.weight.flatten(1)).view(-1, heat.k)
    return torch.cat([taps.T, w])


def readout_constants(
    heat: FourierHeatTransformation, output: nn.Linear, product: Product
) -> Float[Tensor, "3"]:
    """w · b_q, v · b_grad and the output's bias; the arguments are those of ``readout_rows``."""
    w = output.weight
    v = _through_f_q(heat, w, product)
    return torch.stack(
        [(w * _bias(heat.f_q)).sum(), (v * _bias(heat.f_grad)).sum(), output.bias[0]]
    )


def _through_f_q(
    heat: FourierHeatTransformation, w: Float[Tensor, "1 c"], product: Product
) -> Float[Tensor, "1 c"]:
    """v = f_qᵀ w, as a row."""
    return product(w, heat.f_q.weight[:, :, 0])


def _bias(layer: nn.Conv1d) -> Tensor:
    assert layer.bias is not None
    return layer.bias
