"""Random choices of one scene, all from one generator."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from mrgs_synth.textures import Colour

Item = TypeVar("Item")


class Draw:
    """Draws numbers, items and colours; the same seed gives the same sequence."""

    def __init__(self, seed: Sequence[int]) -> None:
        self.rng = np.random.default_rng(list(seed))

    def between(self, low: float, high: float) -> float:
        """A number, evenly distributed."""
        return float(self.rng.uniform(low, high))

    def scale(self, low: float, high: float) -> float:
        """A positive number whose logarithm is evenly distributed."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def whole(self, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``, both included."""
        return int(self.rng.integers(low, high + 1))

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return bool(self.rng.uniform() < probability)

    def one_of(self, *items: Item) -> Item:
        """One of several things, all equally likely."""
        return items[int(self.rng.integers(len(items)))]

    def some(self, items: Sequence[Item], count: int) -> list[Item]:
        """Several different items, in random order."""
        return [items[i] for i in self.rng.permutation(len(items))[:count]]

    def colour(
        self,
        saturation: tuple[float, float] = (0.05, 0.6),
        value: tuple[float, float] = (0.35, 0.95),
    ) -> Colour:
        """An sRGB colour of any hue."""
        r, g, b = colorsys.hsv_to_rgb(
            self.between(0.0, 1.0), self.between(*saturation), self.between(*value)
        )
        return round(255 * r), round(255 * g), round(255 * b)
