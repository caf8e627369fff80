"""A measured mark as the pages with a 3D view list it."""

from __future__ import annotations

import math
from typing import TypedDict

from mrgs.marks.measure import MarkReading
from mrgs.marks.tables import size_text, value_text
from mrgs.scene import TemperatureRange, WorldFrame

MOSTLY_COVERED = 0.98
"""A mark that shows a surface on less of it says so."""


class MarkText(TypedDict):
    """A mark as a panel lists it: what it is, what was measured, and what can be changed."""

    name: str
    kind: str
    value: str
    difference: str
    lines: list[str]
    profile: list[tuple[float, float | None]]
    note: str
    area: bool
    emissivity: float | None
    reflected_c: float | None
    reference: bool


def label_text(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    """What stands beside a mark in a picture: its name, and its mean if there is one."""
    value = "" if reading.problem else value_text(reading.mean, temperature, unit=True)
    return f"{reading.mark.name}  {value}".rstrip()


def mark_text(
    reading: MarkReading,
    reference: str,
    temperature: TemperatureRange | None,
    world: WorldFrame,
) -> MarkText:
    """A mark that was measured.

    Args:
        reading: of the mark.
        reference: name of the mark that all differences refer to; empty for none.
        temperature: the scale of the thermal values; None without known °C.
        world: the frame of the marks' coordinates.
    """
    mark = reading.mark
    return {
        "name": mark.name,
        "kind": mark.kind,
        "value": value_text(reading.mean, temperature, unit=True),
        "difference": ""
        if math.isnan(reading.difference)
        else f"ΔT {value_text(reading.difference, temperature, sign=True, unit=True)}",
        "lines": _lines(reading, temperature, world),
        "profile": _profile(reading),
        "note": mark.note,
        "area": mark.is_area,
        "emissivity": mark.emissivity,
        "reflected_c": mark.reflected_c,
        "reference": mark.name == reference,
    }


def _lines(
    reading: MarkReading, temperature: TemperatureRange | None, world: WorldFrame
) -> list[str]:
    """Extremes, size and photos of a mark; first of all why it has no temperature."""
    lines = [reading.problem] if reading.problem else []
    if not math.isnan(reading.low):
        low = value_text(reading.low, temperature)
        high = value_text(reading.high, temperature, unit=True)
        lines.append(f"{low} to {high}")
    lines.append(size_text(reading, world))
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
