"""The multi-resolution hash grid as a module (Müller et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mrgs.baselines.thermonerf.cpu import CHANNELS, encode
from mrgs.errors import ConfigError

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
        if self.levels < 1:
            raise ConfigError(f"levels must be at least 1, not {self.levels}")
        if not 1 <= self.coarsest <= self.finest <= 2**20:
            raise ConfigError(
                f"a grid's resolutions must be 1 <= coarsest <= finest <= {2**20}, not "
                f"{self.coarsest}, {self.finest}"
            )
        if not 4 <= self.log2_entries <= 24:
            raise ConfigError(f"log2_entries must be from 4 to 24, not {self.log2_entries}")

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
        """The features of all levels, level by level; see ``cpu.encode``."""
        return encode(points, self.table, self.resolutions, self.offsets)
