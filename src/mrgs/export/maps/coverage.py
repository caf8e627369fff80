"""Which part of a map enough photos show."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

LEAST_SHARE = 0.4
"""A place belongs to a map if at least this share of as many photos show it as show the place that
most do. Beyond, a few photos show it from the side, and the map would end in rags."""

SMOOTHED_CELLS = 1.5
"""Standard deviation of the filter over the numbers of photos, in cells."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """How many photos show the places of a map, in square cells.

    Attributes:
        low: map coordinates of the corner of the first cell, [2].
        cell_m: side of a cell, map metres.
        share: photos that show a cell, as a share of the most that show any, [U, V].
    """

    low: Float64[np.ndarray, "2"]
    cell_m: float
    share: Float64[np.ndarray, "u v"]

    @classmethod
    def of(cls, places: Iterable[Float64[np.ndarray, "_ 2"]], cell_m: float) -> Coverage:
        """Of the map coordinates of what each photo shows, at least one place in all.

        Args:
            places: of each photo, [N, 2].
            cell_m: side of a cell, wide enough that a photo misses none that it shows.
        """
        cells = [np.unique(np.floor(each / cell_m).astype(np.int64), axis=0) for each in places]
        every = np.concatenate(cells)
        first = every.min(axis=0)
        photos = np.zeros(every.max(axis=0) - first + 1)
        for each in cells:
            photos[tuple((each - first).T)] += 1
        smooth = ndimage.gaussian_filter(photos, SMOOTHED_CELLS, mode="constant")
        return cls(first * cell_m, cell_m, smooth / smooth.max())

    @property
    def bounds(self) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
        """The smallest and the largest map coordinates of what enough photos show."""
        cells = np.argwhere(self.share >= LEAST_SHARE)
        first, last = cells.min(axis=0), cells.max(axis=0) + 1
        return self.low + first * self.cell_m, self.low + last * self.cell_m

    def holds(
        self, u: Float64[np.ndarray, " w"], v: Float64[np.ndarray, " h"]
    ) -> Bool[np.ndarray, "h w"]:
        """Whether enough photos show the places of a grid, [H, W].

        Args:
            u: map coordinates of its columns.
            v: map coordinates of its rows.
        """
        columns, rows = (
            (each - low) / self.cell_m - 0.5 for each, low in zip((u, v), self.low, strict=True)
        )
        at = np.stack(np.meshgrid(columns, rows))
        share = ndimage.map_coordinates(self.share, at, order=1, mode="constant")
        holds: Bool[np.ndarray, "h w"] = ndimage.binary_fill_holes(share >= LEAST_SHARE)
        return holds
