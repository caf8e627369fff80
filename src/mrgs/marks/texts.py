"""A measured mark as the pages with a 3D view list it."""

from __future__ import annotations

import math
from typing import TypedDict

import numpy as np

from mrgs.marks.measure import MarkReading
from mrgs.marks.tables import (
    DASH,
    around_text,
    corrected_text,
    size_text,
    total_uncertainty,
    value_text,
)
from mrgs.scene import TemperatureRange, WorldFrame

PART_NAMES = {
    "photos": "photos",
    "model": "model",
    "detail": "fine detail",
    "camera": "data sheet",
    "emissivity": "emissivity",
    "reflected": "reflected temperature",
    "distance": "distance",
}
"""What the parts of an uncertainty are called."""

MOSTLY_COVERED = 0.98
"""Covered share of a mark below which its text mentions the share."""


class MarkText(TypedDict):
    """A mark as a panel lists it: what it is, what was measured, and what can be changed."""

    name: str
    kind: str
    value: str
    difference: str
    problem: str
    lines: list[str]
    profile: list[tuple[float, float | None]]
    ends: list[str]
    note: str
    severity: str
    area: bool
    emissivity: float | None
    reflected_c: float | None
    reference: bool


def label_text(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    """Label of a mark in a picture: its name, and its mean if there is one."""
    return f"{reading.mark.name}  {value_with_uncertainty(reading, temperature)}".rstrip()


def value_with_uncertainty(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    """The mean, ± its uncertainty where that is known; empty without a temperature."""
    if reading.problem:
        return ""
    around = total_uncertainty(reading)
    if math.isnan(around):
        return value_text(reading.mean, temperature, unit=True)
    mean = value_text(reading.mean, temperature)
    return f"{mean} ± {around_text(around, temperature, unit=True)}"


def uncertainty_text(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    """The parts of the uncertainty, and whether the camera's own error is missing; empty where it
    is not known."""
    if reading.uncertainty is None or not reading.uncertainty.known:
        return ""
    parts = ", ".join(
        f"{PART_NAMES[name]} {value_text(part, temperature)}"
        for name, part in reading.uncertainty.known.items()
    )
    without = "" if "camera" in reading.uncertainty.known else ", without the camera's own error"
    return f"± for 95 of 100 cases{without}: {parts}"


def mark_text(
    reading: MarkReading,
    reference: str,
    temperature: TemperatureRange | None,
    world: WorldFrame,
) -> MarkText:
    """A mark that was measured.

    Args:
        reference: name of the mark that all differences refer to; empty for none.
    """
    mark = reading.mark
    return {
        "name": mark.name,
        "kind": mark.kind,
        "value": value_with_uncertainty(reading, temperature)
        or value_text(reading.mean, temperature),
        "difference": difference_text(reading, temperature),
        "problem": reading.problem,
        "lines": _lines(reading, temperature, world),
        "profile": _profile(reading),
        "ends": _ends(reading, temperature, world),
        "note": mark.note,
        "severity": mark.severity,
        "area": mark.is_area,
        "emissivity": mark.emissivity,
        "reflected_c": mark.reflected_c,
        "reference": mark.name == reference,
    }


def difference_text(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    """ΔT, ± its uncertainty where that is known; empty without one."""
    if math.isnan(reading.difference):
        return ""
    around = reading.difference_uncertainty
    text = f"ΔT {value_text(reading.difference, temperature, sign=True, unit=math.isnan(around))}"
    if math.isnan(around):
        return text
    unit = "" if temperature is None else " K"
    return f"{text} ± {around_text(around, temperature)}{unit}"


def _lines(
    reading: MarkReading, temperature: TemperatureRange | None, world: WorldFrame
) -> list[str]:
    """Extremes, remarks, size and photos of a mark."""
    lines = []
    if not math.isnan(reading.low):
        low = value_text(reading.low, temperature)
        high = value_text(reading.high, temperature, unit=True)
        lines.append(f"{low} to {high}")
    if doubt := uncertainty_text(reading, temperature):
        lines.append(doubt)
    if not reading.mark.has_settings and (corrected := corrected_text(reading)):
        lines.append(corrected)
    lines.extend(reading.remarks)
    if (size := size_text(reading, world)) != DASH:
        lines.append(size)
    if reading.covered < MOSTLY_COVERED and not reading.problem:
        lines.append(f"{100 * reading.covered:.0f} % of it shows a surface")
    if reading.photos is not None:
        lines.append(f"seen by {reading.photos} thermal photos")
    return lines


def _profile(reading: MarkReading) -> list[tuple[float, float | None]]:
    """Distance and value of a line's samples; None where there is no surface."""
    if reading.profile is None:
        return []
    pairs = zip(reading.profile.distances.tolist(), reading.profile.values.tolist(), strict=True)
    return [(distance, None if math.isnan(value) else value) for distance, value in pairs]


def _ends(
    reading: MarkReading, temperature: TemperatureRange | None, world: WorldFrame
) -> list[str]:
    """The lowest and the highest value of a line's profile and its length, with their units; empty
    without a value."""
    if reading.profile is None or not np.isfinite(reading.profile.values).any():
        return []
    values = np.nanmin(reading.profile.values), np.nanmax(reading.profile.values)
    texts = [value_text(float(value), temperature, unit=True) for value in values]
    return [*texts, str(size_text(reading, world))]
