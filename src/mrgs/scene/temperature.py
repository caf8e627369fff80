"""The scale between normalised thermal values, degrees Celsius and kelvin."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from torch import Tensor

ZERO_CELSIUS_K = 273.15

_COLDEST_SCENE_C, _HOTTEST_SCENE_C = -60.0, 150.0
"""Range in which 98 % of the pixels of everyday photos lie, °C."""

_COLDEST_MIDDLE_C, _HOTTEST_MIDDLE_C = -30.0, 100.0
"""Range in which their median lies, °C."""

Value = TypeVar("Value", float, Tensor, np.ndarray)


@dataclass(frozen=True)
class TemperatureRange:
    """The temperatures that the normalised values 0 and 1 stand for.

    Attributes:
        min_c: temperature of the value 0, °C.
        max_c: temperature of the value 1, °C; larger than ``min_c``.
    """

    min_c: float
    max_c: float

    def __post_init__(self) -> None:
        if not -ZERO_CELSIUS_K <= self.min_c < self.max_c < math.inf:
            raise ValueError(f"not a temperature range in °C: {self.min_c} to {self.max_c}")

    @classmethod
    def around(cls, low: float, high: float) -> TemperatureRange:
        """The range of these temperatures, °C, rounded outwards to whole degrees, and at least one
        degree wide.

        Raises:
            ValueError: they are no temperatures in °C.
        """
        first = math.floor(low)
        return cls(float(first), float(max(math.ceil(high), first + 1)))

    def __str__(self) -> str:
        return f"{self.min_c:g} to {self.max_c:g} °C".replace("-", "−")

    @property
    def span_c(self) -> float:
        """Width of the range in °C (equally in K)."""
        return self.max_c - self.min_c

    def to_celsius(self, value: Value) -> Value:
        """Normalised value -> °C."""
        return value * self.span_c + self.min_c

    def to_kelvin(self, value: Value) -> Value:
        """Normalised value -> K."""
        return self.to_celsius(value) + ZERO_CELSIUS_K

    def from_celsius(self, celsius: Value) -> Value:
        """°C -> normalised value (outside [0, 1] where the temperature is outside the range)."""
        return (celsius - self.min_c) / self.span_c


def are_everyday(low: float, middle: float, high: float) -> bool:
    """Whether the 1st, 50th and 99th percentile of photos, in °C, are those of everyday scenes: for
    telling units apart."""
    in_scene = low >= _COLDEST_SCENE_C and high <= _HOTTEST_SCENE_C
    return in_scene and _COLDEST_MIDDLE_C <= middle <= _HOTTEST_MIDDLE_C
