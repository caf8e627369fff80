"""Rectangles in the plane of a scene, and how it is cut into them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.scene import Scene
from mrgs.scene.arrays import constant

TRIMMED = 0.02
"""Share of the points at either end that are ignored as outliers."""

MOST_BLOCKS = 10_000


class ScenePlane(NamedTuple):
    """The plane in which a scene is cut: unit vectors along and across it in world coordinates, the
    longer side first, and the smallest and the largest coordinates of the scene along both, but for
    stray points, scene units."""

    axes: tuple[tuple[float, float, float], tuple[float, float, float]]
    low: tuple[float, float]
    high: tuple[float, float]

    def coordinates(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Coordinates of points of the world along both axes."""
        return points @ constant(self.axes, points).T

    @property
    def sides(self) -> tuple[float, float]:
        """Lengths of the scene along both axes, scene units."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    def clipped(self, region: Rectangle) -> tuple[float, float]:
        """Lengths of a region as far as it lies in the scene."""
        first, second = (
            min(region.high[axis], self.high[axis]) - max(region.low[axis], self.low[axis])
            for axis in (0, 1)
        )
        return first, second


class Rectangle(NamedTuple):
    """A rectangle of the plane, from ``low`` up to but without ``high``; both may be infinite."""

    low: tuple[float, float]
    high: tuple[float, float]

    def contains(
        self, places: Float[Tensor, "*batch 2"], reach: Float[Tensor, "*batch"] | None = None
    ) -> Bool[Tensor, "*batch"]:
        """Whether coordinates of the plane are in it, or as near as ``reach``; NaN is not."""
        low, high = (constant(end, places) for end in self)
        about = places.new_zeros(1) if reach is None else reach[..., None]
        return ((places - about >= low) & (places + about < high)).all(dim=-1)

    def grown(self, margin: float) -> Rectangle:
        """The rectangle with a margin on all sides, scene units."""
        return Rectangle(
            (self.low[0] - margin, self.low[1] - margin),
            (self.high[0] + margin, self.high[1] + margin),
        )

    @classmethod
    def from_json(cls, value: Any) -> Rectangle:
        """A region from ``to_json``. TypeError or ValueError if the value is not a region."""
        low, high = value
        return cls(_ends(low, -math.inf), _ends(high, math.inf))

    def to_json(self) -> list[list[float | None]]:
        """Both ends; null where the rectangle is infinite."""
        return [[x if math.isfinite(x) else None for x in end] for end in self]


class Ring(NamedTuple):
    """What lies in one rectangle and not in another."""

    outer: Rectangle
    inner: Rectangle

    def contains(
        self, places: Float[Tensor, "*batch 2"], reach: Float[Tensor, "*batch"] | None = None
    ) -> Bool[Tensor, "*batch"]:
        """Whether coordinates of the plane are in it, see ``Rectangle.contains``."""
        within = self.inner.contains(places, None if reach is None else -reach)
        return self.outer.contains(places, reach) & ~within


def plane_of(scene: Scene) -> ScenePlane:
    """The plane of a scene: the horizontal one where that is known, else the one in which cameras
    and points spread most; the axes follow the longest extent in it."""
    places = torch.cat(
        [
            scene.points.positions.double(),
            torch.stack([camera.position for camera in scene.train_cameras]),
        ]
    )
    middle = places.median(dim=0).values
    near = places[((places - middle).norm(dim=1) <= scene.reach.radius)] - middle
    spread = near.T @ near
    if scene.world.north:
        spread[2], spread[:, 2] = 0.0, 0.0
    directions = torch.linalg.eigh(spread).eigenvectors.T.flip(0)[:2]
    # The sign of an eigenvector is the library's choice: the largest component is positive.
    largest = directions.gather(1, directions.abs().argmax(dim=1, keepdim=True))
    axes = directions * largest.sign()
    across = (scene.points.positions.double() @ axes.T).sort(dim=0).values
    trimmed = int(TRIMMED * len(across))
    low, high = across[trimmed], across[-1 - trimmed]
    (x1, y1, z1), (x2, y2, z2) = axes.tolist()
    (low1, low2), (high1, high2) = low.tolist(), high.tolist()
    return ScenePlane(((x1, y1, z1), (x2, y2, z2)), (low1, low2), (high1, high2))


def cells(places: Float64[Tensor, "n 2"], rows: int, columns: int) -> list[list[Rectangle]]:
    """Rectangles that fill the plane with equally many places each: columns along the first axis,
    cut into rows along the second; the outermost ones have no end."""
    found = []
    edges = _edges(places[:, 0], columns)
    for left, right in pairwise(edges):
        inside = places[(places[:, 0] >= left) & (places[:, 0] < right), 1]
        across = _edges(inside, rows)
        found.append([Rectangle((left, low), (right, high)) for low, high in pairwise(across)])
    return found


def without_empty(
    columns: Sequence[Sequence[Rectangle]], is_empty: Callable[[Rectangle], bool]
) -> list[Rectangle]:
    """Rectangles of which each empty one has been joined with its neighbour in the column, and an
    empty column with its neighbour."""
    kept: list[list[Rectangle]] = []
    for column in columns:
        filled: list[Rectangle] = []
        for cell in column:
            if filled and (is_empty(cell) or is_empty(filled[-1])):
                filled[-1] = Rectangle(filled[-1].low, cell.high)
            else:
                filled.append(cell)
        kept.append(filled)
    while len(kept) > 1 and (bare := [each for each in kept if all(map(is_empty, each))]):
        place = kept.index(bare[0])
        other = place - 1 if place else 1
        left, right = min(place, other), max(place, other)
        edges = kept[left][0].low[0], kept[right][0].high[0]
        kept[left : right + 1] = [
            [Rectangle((edges[0], each.low[1]), (edges[1], each.high[1])) for each in kept[other]]
        ]
    return [cell for column in kept for cell in column]


def parse_grid(blocks: str) -> tuple[int, int] | None:
    """Rows and columns of ``ROWSxCOLUMNS``; None for ``auto``. ConfigError for anything else."""
    if blocks == "auto":
        return None
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", blocks)
    if found is None or not 1 <= int(found[1]) * int(found[2]) <= MOST_BLOCKS:
        raise ConfigError(
            f"blocks are auto, or ROWSxCOLUMNS such as 2x3, not {blocks!r}", options=("blocks",)
        )
    return int(found[1]), int(found[2])


def shape_for(count: int, sides: tuple[float, float]) -> tuple[int, int]:
    """Rows and columns of at least ``count`` about square cells, in a plane of these sides."""
    columns = max(1, round(math.sqrt(count * sides[0] / max(sides[1], 1e-9 * sides[0]))))
    columns = min(columns, count)
    return math.ceil(count / columns), columns


def _edges(values: Float64[Tensor, " n"], parts: int) -> list[float]:
    """Bounds of parts with equally many of the values; fewer parts where values do not differ."""
    if parts == 1 or not len(values):
        return [-math.inf, math.inf]
    # As torch.quantile, which takes no more than 16 million values.
    ascending = torch.from_numpy(np.sort(values.numpy()))
    ranks = torch.arange(1, parts, dtype=torch.float64) / parts * (len(values) - 1)
    below, above = ascending[ranks.floor().long()], ascending[ranks.ceil().long()]
    found = below.lerp(above, ranks - ranks.floor())
    return [-math.inf, *sorted(set(found.tolist())), math.inf]


def _ends(values: Any, infinite: float) -> tuple[float, float]:
    first, second = (infinite if value is None else float(value) for value in values)
    return first, second
