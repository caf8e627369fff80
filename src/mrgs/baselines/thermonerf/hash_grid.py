"""The multi-resolution hash grid as a module (Müller et al. 2022)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from mrgs.errors import ConfigError
from mrgs.system.limits import require_within
from mrgs.system.operation import Kernel, operation, register_kernels

CHANNELS = 4
"""Features of an entry."""

PRIMES = (1, 2_654_435_761, 805_459_861)
"""Of the spatial hash, by axis."""

MOST_LEVELS = 32

INITIAL_RANGE = 1e-4
"""Features start uniformly within ± this, as in the paper's Section 4."""


@dataclass(frozen=True)
class HashGridConfig:
    """Size of a hash grid.

    Attributes:
        levels: grids of growing resolution, each with 4 features per entry.
        coarsest: cells along an axis of the first level.
        finest: cells along an axis of the last level; the levels between grow geometrically.
        log2_entries: a level has at most 2 to this power entries; corners beyond that share them by
            a hash.
    """

    levels: int = 8
    coarsest: int = 16
    finest: int = 1_024
    log2_entries: int = 17

    def __post_init__(self) -> None:
        require_within(self, ["levels"], 1, MOST_LEVELS)
        if not 1 <= self.coarsest <= self.finest <= 2**20:
            raise ConfigError(
                f"a grid's resolutions must be 1 <= coarsest <= finest <= {2**20}, not "
                f"{self.coarsest}, {self.finest}"
            )
        require_within(self, ["log2_entries"], 4, 24)

    @property
    def resolutions(self) -> list[int]:
        """Cells along an axis of each level (Eq. 2 and 3 of the paper)."""
        growth = (self.finest / self.coarsest) ** (1 / max(1, self.levels - 1))
        return [round(self.coarsest * growth**level) for level in range(self.levels)]


class HashGrid(nn.Module):
    """Features of points in [0, 1]³.

    Attributes:
        table: the features of all levels, one after the other, [entries, 4].
    """

    resolutions: Tensor
    offsets: Tensor

    def __init__(self, config: HashGridConfig) -> None:
        super().__init__()
        sizes = [
            min((resolution + 1) ** 3, 2**config.log2_entries) for resolution in config.resolutions
        ]
        self.width = CHANNELS * config.levels
        self.table = nn.Parameter(
            torch.empty(sum(sizes), CHANNELS).uniform_(-INITIAL_RANGE, INITIAL_RANGE)
        )
        offsets = torch.tensor([0, *sizes]).cumsum(dim=0)
        self.register_buffer("resolutions", torch.tensor(config.resolutions), persistent=False)
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
        points: in [0, 1]³; what lies outside counts as on the border.
        table: features of all levels, one after the other; of the same type as the points, float32
            or float64.
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
        "mrgs.baselines.thermonerf.kernels.hash_grid.encode",
        "cpu",
        (torch.float32, torch.float64),
    )
)


def _encode_level(
    points: Float[Tensor, "n 3"], table: Float[Tensor, "entries 4"], cells: int
) -> Float[Tensor, "n 4"]:
    """Features of points in [0, 1]³ on one level of so many cells along an axis."""
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
