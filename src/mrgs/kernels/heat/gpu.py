"""t̂ on a GPU: torch's own kernels, with the numbers of ``readout`` in place of the features.

It computes the features of all Gaussians: to learn how many are needed, the host would have to wait
for the device.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.field import RadianceField
from mrgs.field.rows import take
from mrgs.field.spherical_harmonics import MAX_DEGREE, up_to_degree
from mrgs.kernels.heat.readout import readout_constants, readout_rows
from mrgs.scene import RGB, THERMAL, Gaussians


def temperature_residuals(
    field: RadianceField,
    gaussians: Gaussians,
    neighbours: Int64[Tensor, "n k"] | None,
    rows: Int64[Tensor, " v"] | None = None,
    color_degree: int = MAX_DEGREE,
) -> Float[Tensor, "v 1"]:
    """``RadianceField.temperature_residuals`` for float32 on a GPU."""
    neighbours = field.checked_neighbours(neighbours, len(gaussians))
    heat, output, scale = field.heat, field.temperature_output, field.config.temperature_scale
    rest = up_to_degree(gaussians.sh_rest[RGB], color_degree)
    e_t = field.extraction(gaussians.embedding, torch.cat([gaussians.sh_dc[RGB], rest], dim=1))
    features = field.thermal_head(e_t, field.normalised(gaussians.means))
    projected = features @ readout_rows(heat, output, torch.matmul).T
    if heat.k == 0:
        return scale * (take(projected, rows) + output.bias)
    refined = exchange(
        projected,
        take(gaussians.opacity(THERMAL), rows),
        readout_constants(heat, output, torch.matmul),
        take(neighbours, rows),
        take(projected, rows),
        (heat.anchor_weight, heat.surrounding_weight),
    )
    return scale * refined[:, None]


def exchange(
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
