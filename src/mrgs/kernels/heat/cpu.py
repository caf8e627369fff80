"""t̂ on the CPU: a fused pass for the features, then the exchange of ``readout``'s numbers."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from mrgs.field import RadianceField
from mrgs.field.rows import take
from mrgs.field.spherical_harmonics import MAX_DEGREE, up_to_degree
from mrgs.kernels.dense.small_product import product
from mrgs.kernels.heat.exchange import exchange, with_neighbours
from mrgs.kernels.heat.readout import readout_constants, readout_rows
from mrgs.kernels.heat.thermal_head import project_features
from mrgs.kernels.rows import listed
from mrgs.scene import RGB, THERMAL, Gaussians


def temperature_residuals(
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
