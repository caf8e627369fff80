"""Uneven ground: heights on a grid, and what covers them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from mrgs_synth import textures

STEP_M = 1.0
"""Between the points of the grid; the ground between four of them is bilinear."""

WAVES = ((14.0, 0.08), (37.0, 0.35), (90.0, 0.9))
"""Length and height (metres) of the ground's undulations, from small to large."""

TILE_PX = 1024
TILE_M = 30.0
"""The ground's pattern repeats after so many metres; patches of the grid's size do not."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Uneven ground.

    Attributes:
        low: x and y of the grid's first point, metres.
        heights: z of the grid's points in metres, rows along y, [R, C].
        patches: how lush the grass is at the grid's points, 0 to 1, [R, C].
        pattern: brightness of the grass, 0 to 1, repeated every ``TILE_M``, [P, P].
    """

    low: tuple[float, float]
    heights: Float[np.ndarray, "r c"]
    patches: Float[np.ndarray, "r c"]
    pattern: Float[np.ndarray, "p p"]

    @classmethod
    def drawn(
        cls, low: tuple[float, float], high: tuple[float, float], rng: np.random.Generator
    ) -> Ground:
        """Ground over a rectangle (metres)."""
        columns, rows = (
            int(np.ceil((end - start) / STEP_M)) + 2 for start, end in zip(low, high, strict=True)
        )
        y, x = STEP_M * np.mgrid[:rows, :columns]
        heights = np.zeros((rows, columns))
        for length, height in WAVES:
            for turn in rng.uniform(0.0, np.pi, 3):
                along = x * np.cos(turn) + y * np.sin(turn)
                phase = rng.uniform(0.0, 2.0 * np.pi)
                heights += height / 3 * np.sin(2.0 * np.pi * along / length + phase)
        cells = max(rows // 8, 1), max(columns // 8, 1)
        return cls(
            low,
            heights,
            textures.noise(rows, columns, cells, rng),
            _repeating(textures.noise(TILE_PX, TILE_PX, (60, 60), rng)),
        )

    def height_at(
        self, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """z of the ground, metres."""
        place = [(y - self.low[1]) / STEP_M, (x - self.low[0]) / STEP_M]
        found: Float[np.ndarray, " n"] = map_coordinates(
            self.heights, place, order=1, mode="nearest"
        )
        return found


def _repeating(tile: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """A pattern whose opposite edges fit: it fades into its own mirror image there."""
    for axis in (0, 1):
        width = tile.shape[axis] // 8
        weight = np.linspace(0.5, 0.0, width).reshape((-1, 1) if axis == 0 else (1, -1))
        first = np.take(tile, range(width), axis)
        last = np.flip(np.take(tile, range(tile.shape[axis] - width, tile.shape[axis]), axis), axis)
        mixed = (1.0 - weight) * first + weight * last, (1.0 - weight) * last + weight * first
        parts = np.take(tile, range(width, tile.shape[axis] - width), axis)
        tile = np.concatenate([mixed[0], parts, np.flip(mixed[1], axis)], axis)
    return tile
