"""The parts that the paper adds to a model: how much each contributes, and the model without it."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.field import RadianceField
from mrgs.field.appearance import color_residuals
from mrgs.field.heat import FourierHeatTransformation
from mrgs.render import Model
from mrgs.scene import TemperatureRange


class PartSpreads(NamedTuple):
    """How much the parts of a model differ from Gaussian to Gaussian: a part that is the same for
    all contributes nothing.

    Attributes:
        temperature_residual: standard deviation of t̂, normalised temperature.
        heat_exchange: standard deviation of what the Fourier heat transformation adds to t̂,
            normalised temperature; 0 for a field without it.
        color_residual: standard deviation of ĉ over Gaussians and channels, colours in [0, 1].
    """

    temperature_residual: float
    heat_exchange: float
    color_residual: float

    def to_json(self, temperature: TemperatureRange | None) -> dict[str, float | None]:
        """The spreads as ``metrics.json`` and ``log.jsonl`` name them, in °C; None without °C."""
        spread, exchange = (
            None if temperature is None else value * temperature.span_c
            for value in (self.temperature_residual, self.heat_exchange)
        )
        return {
            "temperature_residual_std_c": spread,
            "heat_exchange_std_c": exchange,
            "color_residual_std": self.color_residual,
        }


@torch.no_grad()
def part_spreads(model: Model, camera_position: Float[Tensor, "3"]) -> PartSpreads | None:
    """The spreads of a model's parts, ĉ as seen from a camera; None without residuals."""
    if not model.field.config.residuals or len(model.gaussians) < 2:
        return None
    if model.neighbours is None:
        model = replace(model, neighbours=model.field.neighbours_of(model.gaussians.means))
    residual = _temperature_residuals(model, model.field)
    alone = _temperature_residuals(model, without_heat_exchange(model.field))
    position = camera_position.to(model.gaussians.means)
    color = color_residuals(
        model.field.color_head, model.gaussians.embedding, model.gaussians.means, position
    )
    return PartSpreads(
        residual.std().item(), (residual - alone).std().item(), (color - color.mean(0)).std().item()
    )


def without_heat_exchange(field: RadianceField) -> RadianceField:
    """A copy of a field whose Gaussians exchange no heat: F' = F in Eq. 12."""
    copy = deepcopy(field)
    copy.config = replace(field.config, fourier=False)
    copy.heat = _NoHeatTransformation(field.config.thermal_feature_width, 0, 1.0, 0.0)
    return copy


class _NoHeatTransformation(FourierHeatTransformation):
    """F' = F, whatever equation stands in its place."""

    def forward(self, features: Tensor, opacity: Tensor, neighbours: Tensor) -> Tensor:
        return features[: len(neighbours)]


@torch.no_grad()
def knock_outs(model: Model) -> Mapping[str, Model]:
    """A trained model with one part knocked out in each copy; none for a field without residuals:
    ``temperature_residual``: t̂ is its mean; ``heat_exchange``: F' = F; ``shuffled_neighbours``:
    each Gaussian has another one's; ``color_residual``: ĉ = 0. A part without effect is unused."""
    field = model.field
    if not field.config.residuals:
        return {}
    mean = _temperature_residuals(model, field).mean(0, keepdim=True)
    without_color = deepcopy(field)
    without_color.color_head.scale = 0.0
    copies = {
        "temperature_residual": _with_residuals(model, mean),
        "color_residual": replace(model, field=without_color),
    }
    if field.config.neighbours_k > 0:
        alone = _temperature_residuals(model, without_heat_exchange(field))
        shuffled = _temperature_residuals(_with_shuffled_neighbours(model), field)
        copies["heat_exchange"] = _with_residuals(model, alone)
        copies["shuffled_neighbours"] = _with_residuals(model, shuffled)
    return copies


def _temperature_residuals(model: Model, field: RadianceField) -> Float[Tensor, "n 1"]:
    neighbours = model.neighbours if field.config.neighbours_k > 0 else None
    residuals: Tensor = field.temperature_residuals(
        model.gaussians, neighbours, color_degree=model.sh_degree
    )
    return residuals


def _with_residuals(model: Model, residuals: Float[Tensor, "n 1"]) -> Model:
    return replace(model, temperature_residuals=residuals.expand(len(model.gaussians), 1))


def _with_shuffled_neighbours(model: Model) -> Model:
    """The neighbours' rows in another order, the same each time."""
    assert model.neighbours is not None
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(model.neighbours), generator=generator)
    return replace(model, neighbours=model.neighbours[order.to(model.neighbours.device)])
