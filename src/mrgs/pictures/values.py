"""What the values of a modality's images mean to people: their unit, their range, their colours."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from torch import Tensor

from mrgs.pictures.drawing import Scale
from mrgs.pictures.palette import PaletteName
from mrgs.scene import THERMAL, Modality, TemperatureRange
from mrgs.system.wording import number_text

Value = TypeVar("Value", float, Tensor, np.ndarray)

LEAST_STEPS = 20
"""Values that texts tell apart in the range of temperatures."""

MOST_DECIMALS = 4

NORMALISED = "normalised"
"""Stands for the unit of values between 0 and 1 that have none."""


def in_unit(modality: Modality, values: Value, temperature: TemperatureRange | None) -> Value:
    """Normalised values of a modality in its unit, see ``unit_of``: thermal ones in °C where the
    scene has a temperature range, all others unchanged."""
    celsius = _celsius(modality, temperature)
    return values if celsius is None else celsius.to_celsius(values)


def range_of(modality: Modality, temperature: TemperatureRange | None) -> tuple[float, float]:
    """What the normalised values 0 and 1 of a modality stand for, in the unit of ``unit_of``."""
    celsius = _celsius(modality, temperature)
    return (0.0, 1.0) if celsius is None else (celsius.min_c, celsius.max_c)


def unit_of(modality: Modality, temperature: TemperatureRange | None) -> str:
    """The unit in which a modality's values are shown; ``NORMALISED`` for intensities, and for
    temperatures of a scene without °C."""
    if modality == THERMAL and temperature is None:
        return NORMALISED
    return modality.unit or NORMALISED


def unit_label(modality: Modality, temperature: TemperatureRange | None) -> str:
    """The unit in which a modality's values are shown; empty for normalised values."""
    return unit_of(modality, temperature).replace(NORMALISED, "")


def full_scale(
    modality: Modality, temperature: TemperatureRange | None, palette: PaletteName
) -> Scale:
    """The scale over a one-channel modality's range: in the palette with a unit, else in grey."""
    colors: PaletteName = palette if modality.is_metric else "grey"
    return Scale(colors, *range_of(modality, temperature), unit_of(modality, temperature))


def decimals_of(modality: Modality, temperature: TemperatureRange | None) -> int:
    """Decimals of a modality's values as text: 3 for numbers between 0 and 1; for °C 1, and more
    where the whole range is no more than a few of the last digits."""
    celsius = _celsius(modality, temperature)
    if celsius is None:
        return 3
    return min(max(1, math.ceil(math.log10(LEAST_STEPS / celsius.span_c))), MOST_DECIMALS)


def format_value(
    modality: Modality, value: float, temperature: TemperatureRange | None, *, sign: bool = False
) -> str:
    """A value in the unit of ``unit_of`` as text with that unit, normalised values without one; see
    ``number_text`` for the sign."""
    text = number_text(value, decimals_of(modality, temperature), sign=sign)
    return f"{text} {unit_label(modality, temperature)}".rstrip()


def capitalised(text: str) -> str:
    """A title or a quantity at the beginning of a line."""
    return text[:1].upper() + text[1:]


def folder_of_values(modality: Modality, temperature: TemperatureRange | None) -> tuple[str, str]:
    """Folder of the float32 files of a metric modality's values, and each file's description."""
    if _celsius(modality, temperature) is None:
        return f"{modality}_normalised", f"normalised {modality} value, no unit"
    return "temperature_c", "temperature, degrees Celsius"


def _celsius(modality: Modality, temperature: TemperatureRange | None) -> TemperatureRange | None:
    """The temperature range, for the thermal modality alone."""
    return temperature if modality == THERMAL else None
