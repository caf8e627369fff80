"""The two networks: the field with its two heads, and the proposal network that knows the density
only roughly. Both are a multi-resolution hash grid (Müller et al. 2022) and perceptrons."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn.functional import linear, relu

from mrgs.field.spherical_harmonics import evaluate_sh
from mrgs.system.operation import Kernel, operation, register_kernels
from mrgs_thermonerf.rays import contract

CHANNELS = 4
"""Features of an entry."""

PRIMES = (1, 2_654_435_761, 805_459_861)
"""Of the spatial hash, by axis."""

INITIAL_RANGE = 1e-4
"""Features start uniformly within ± this, as in the paper's Section 4."""


class GridSize(NamedTuple):
    """Size of a hash grid.

    Attributes:
        levels: grids of growing resolution, each with 4 features per entry.
        coarsest: cells along an axis of the first level.
        finest: cells along an axis of the last level; the levels between grow geometrically.
        log2_entries: a level has at most 2 to this power entries; corners beyond that share them by
            a hash.
    """

    levels: int
    coarsest: int
    finest: int
    log2_entries: int

    @property
    def resolutions(self) -> list[int]:
        """Cells along an axis of each level (Eq. 2 and 3 of the paper)."""
        growth = (self.finest / self.coarsest) ** (1 / max(1, self.levels - 1))
        return [round(self.coarsest * growth**level) for level in range(self.levels)]


class HashGrid(nn.Module):
    """Features of points in [0, 1]³; ``table`` has those of all levels in order, [entries, 4]."""

    resolutions: Tensor
    offsets: Tensor

    def __init__(self, size: GridSize) -> None:
        super().__init__()
        sizes = [min((cells + 1) ** 3, 2**size.log2_entries) for cells in size.resolutions]
        self.width = CHANNELS * size.levels
        self.table = nn.Parameter(
            torch.empty(sum(sizes), CHANNELS).uniform_(-INITIAL_RANGE, INITIAL_RANGE)
        )
        offsets = torch.tensor([0, *sizes]).cumsum(dim=0)
        self.register_buffer("resolutions", torch.tensor(size.resolutions), persistent=False)
        self.register_buffer("offsets", offsets, persistent=False)

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]:
        """The features of all levels, level by level; see ``encode``."""
        return encode(points, self.table, self.resolutions, self.offsets)


@operation
def encode(
    points: Float[Tensor, "n 3"],
    table: Float[Tensor, "entries 4"],
    resolutions: Int64[Tensor, " levels"],
    offsets: Int64[Tensor, " levels+1"],
) -> Float[Tensor, "n 4*levels"]:
    """Features of points, level by level: trilinear interpolation between the corners of a cell
    (Müller et al. 2022, Section 3). The gradient reaches the table, not the points.

    Args:
        points: in [0, 1]³; others count as on the border.
        table: features of all levels, one after the other; of the points' type.
        resolutions: cells along an axis, of each level.
        offsets: first entry of each level, and the number of all entries. A level with an entry for
            each of its (resolution + 1)³ corners is indexed directly, a smaller one by a hash; its
            size is then a power of two.
    """
    points = points.detach().nan_to_num().clamp(0, 1)
    levels = zip(resolutions.tolist(), offsets.tolist(), offsets[1:].tolist(), strict=False)
    return torch.cat(
        [_encode_level(points, table[first:end], cells) for cells, first, end in levels], dim=1
    )


register_kernels(
    Kernel(
        encode.name,
        "mrgs_thermonerf.kernels.hash_grid.encode",
        "cpu",
        (torch.float32, torch.float64),
    )
)


def _encode_level(
    points: Float[Tensor, "n 3"], table: Float[Tensor, "entries 4"], cells: int
) -> Float[Tensor, "n 4"]:
    """Features of points in [0, 1]³ on one level with a number of cells along each axis."""
    places = points * cells
    cell = places.floor().clamp_max(cells - 1)
    near = places - cell
    features = points.new_zeros(len(points), table.shape[1])
    for corner in itertools.product((0, 1), repeat=3):
        is_far = torch.tensor(corner, device=points.device)
        weights = torch.where(is_far == 1, near, 1 - near).prod(dim=1, keepdim=True)
        entries = _entries(cell.long() + is_far, cells, len(table))
        features = features + weights * table.index_select(0, entries)
    return features


def _entries(corners: Int64[Tensor, "n 3"], cells: int, size: int) -> Int64[Tensor, " n"]:
    """Entry of each corner: by its number if there is one for each, else by a hash."""
    x, y, z = corners.unbind(dim=1)
    if (cells + 1) ** 3 <= size:
        return x + (cells + 1) * (y + (cells + 1) * z)
    hashed = (x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])
    return hashed % size


class Perceptron(nn.Module):
    """Linear, ReLU, linear."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs, hidden)
        self.output = nn.Linear(hidden, outputs)

    def forward(self, inputs: Float[Tensor, "n i"]) -> Float[Tensor, "n o"]:
        """The outputs, without an activation."""
        return perceptron(
            inputs, self.hidden.weight, self.hidden.bias, self.output.weight, self.output.bias
        )


@operation
def perceptron(
    inputs: Float[Tensor, "n i"],
    hidden_weight: Float[Tensor, "h i"],
    hidden_bias: Float[Tensor, " h"],
    output_weight: Float[Tensor, "o h"],
    output_bias: Float[Tensor, " o"],
) -> Float[Tensor, "n o"]:
    """Linear, ReLU, linear; differentiable in every argument."""
    return linear(relu(linear(inputs, hidden_weight, hidden_bias)), output_weight, output_bias)


register_kernels(Kernel(perceptron.name, "mrgs_thermonerf.kernels.perceptron.perceptron", "cpu"))

HARMONICS = 16
"""Functions of the viewing direction that the colour head gets: all up to degree 3."""

LARGEST_LOG_DENSITY = 10.0
"""Denser than e¹⁰ per radius, an interval of any length is opaque."""

FIELD_GRID, FIELD_UNITS = GridSize(8, 16, 1_024, 17), 64
PROPOSAL_GRID, PROPOSAL_UNITS = GridSize(5, 16, 256, 15), 16
"""Grids of both networks, and units of their hidden layers."""

FEATURES = 15
"""Numbers that the density network hands to the heads."""


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

    def __init__(self, grid: GridSize = FIELD_GRID, units: int = FIELD_UNITS) -> None:
        super().__init__()
        self.grid = HashGrid(grid)
        self.geometry = Perceptron(self.grid.width, units, 1 + FEATURES)
        self.color_head = Perceptron(FEATURES + HARMONICS, units, 3)
        self.temperature_head = Perceptron(FEATURES, units, 1)

    def density(
        self, positions: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n f"]]:
        """Density per radius, and the geometry features; positions are in radii from the centre."""
        outputs = self.geometry(self.grid(contract(positions)))
        return density_of(outputs[:, 0]), outputs[:, 1:]

    def color(
        self, features: Float[Tensor, "n f"], harmonics: Float[Tensor, "n 16"]
    ) -> Float[Tensor, "n 3"]:
        """RGB in (0, 1) of geometry features, along directions as ``harmonics_of`` gives them."""
        return self.color_head(torch.cat([features, harmonics], dim=1)).sigmoid()

    def temperature(self, features: Float[Tensor, "n f"]) -> Float[Tensor, "n 1"]:
        """Normalised temperature in (0, 1), the same from every side: taken for Lambertian."""
        return self.temperature_head(features).sigmoid()


class Proposal(nn.Module):
    """A small density network without heads."""

    def __init__(self) -> None:
        super().__init__()
        self.grid = HashGrid(PROPOSAL_GRID)
        self.geometry = Perceptron(self.grid.width, PROPOSAL_UNITS, 1)

    def density(self, positions: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Densities per radius; positions are in radii from the scene's centre."""
        return density_of(self.geometry(self.grid(contract(positions)))[:, 0])
