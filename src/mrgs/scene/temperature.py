"""The scale between normalised thermal values, degrees Celsius and kelvin."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from torch import Tensor

ZERO_CELSIUS_K = 273.15

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

    def __str__(self) -> str:
        return f"{self.min_c:g} to {self.max_c:g} °C"

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
