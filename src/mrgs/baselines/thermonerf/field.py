"""The two networks: the field with its two heads, and the proposal network that knows the density
only roughly."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mrgs.baselines.thermonerf.frame import contract
from mrgs.baselines.thermonerf.hash_grid import HashGrid, HashGridConfig
from mrgs.baselines.thermonerf.perceptron import Perceptron
from mrgs.field.spherical_harmonics import evaluate_sh
from mrgs.system.limits import MOST_WIDTH, require_within

HARMONICS = 16
"""Functions of the viewing direction that the colour head gets: all up to degree 3."""

LARGEST_LOG_DENSITY = 10.0
"""Denser than e¹⁰ per radius, an interval of any length is opaque."""

PROPOSAL_UNITS = 16


@dataclass(frozen=True)
class NerfFieldConfig:
    """Size of the field.

    Attributes:
        grid: the hash grid.
        hidden_width: units of the hidden layer of the density network and of both heads.
        feature_width: numbers that the density network hands to the heads.
    """

    grid: HashGridConfig = dataclasses.field(default_factory=HashGridConfig)
    hidden_width: int = 64
    feature_width: int = 15

    def __post_init__(self) -> None:
        require_within(self, ("hidden_width", "feature_width"), 1, MOST_WIDTH)


def density_of(logits: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """σ = exp(logit − 1) per radius, limited so that it stays finite."""
    return torch.exp((logits - 1).clamp(max=LARGEST_LOG_DENSITY))


def harmonics_of(directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 16"]:
    """The real spherical harmonics up to degree 3 of unit vectors."""
    each = torch.eye(HARMONICS, dtype=directions.dtype)
    count = len(directions)
    return evaluate_sh(each[:1].expand(count, 1, -1), each[1:].expand(count, -1, -1), directions, 3)


class Field(nn.Module):
    """Density shared by both modalities, colour that depends on the view, temperature that does
    not."""

    def __init__(self, config: NerfFieldConfig) -> None:
        super().__init__()
        width, features = config.hidden_width, config.feature_width
        self.grid = HashGrid(config.grid)
        self.geometry = Perceptron(self.grid.width, width, 1 + features)
        self.color_head = Perceptron(features + HARMONICS, width, 3)
        self.temperature_head = Perceptron(features, width, 1)

    def density(
        self, positions: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n f"]]:
        """Densities per radius, and the geometry features; positions are in radii from the scene's
        centre."""
        outputs = self.geometry(self.grid(contract(positions)))
        return density_of(outputs[:, 0]), outputs[:, 1:]

    def color(
        self, features: Float[Tensor, "n f"], harmonics: Float[Tensor, "n 16"]
    ) -> Float[Tensor, "n 3"]:
        """RGB in (0, 1) of geometry features seen along directions (as ``harmonics_of`` gives
        them)."""
        return self.color_head(torch.cat([features, harmonics], dim=1)).sigmoid()

    def temperature(self, features: Float[Tensor, "n f"]) -> Float[Tensor, "n 1"]:
        """Normalised temperature in (0, 1), the same from every side: thermal radiation is
        Lambertian here."""
        return self.temperature_head(features).sigmoid()


class Proposal(nn.Module):
    """A small density network without heads."""

    def __init__(self, config: HashGridConfig) -> None:
        super().__init__()
        self.grid = HashGrid(config)
        self.geometry = Perceptron(self.grid.width, PROPOSAL_UNITS, 1)

    def density(self, positions: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Densities per radius; positions are in radii from the scene's centre."""
        return density_of(self.geometry(self.grid(contract(positions)))[:, 0])
