"""What the panel says, as plain text: the page shows it as text, so that nothing in it can become
a tag."""

from __future__ import annotations

import math
from typing import TypedDict

from mrgs.marks.measure import MarkReading
from mrgs.marks.tables import size_text, value_text
from mrgs.scene import THERMAL, Modality, WorldFrame
from mrgs.viewer.inspection import PointReading
from mrgs.viewer.picking import ValueReading
from mrgs.viewer.settings import Subject

MOSTLY_COVERED = 0.98
"""A mark that shows a surface on less of it says so."""

EMPTY_HINT = "Nothing there: the model is empty at this point."


class ReadingText(TypedDict):
    """A point that was read: the value in large type, its deviation, and further lines."""

    value: str
    deviation: str
    lines: list[str]


class MarkText(TypedDict):
    """A mark as the panel lists it: what it is, what was measured, and what can be changed."""

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


def header(subject: Subject) -> str:
    """The temperature range, or why there is none."""
    scale = subject.temperature
    if THERMAL not in subject.modalities:
        shown = ", ".join(modality.quantity for modality in subject.modalities)
        return f"No thermal photos: {shown} and depth only."
    if scale is None:
        return "This scene has no known °C: temperatures are normalised, 0 to 1."
    return f"Recorded range {number(scale.min_c, 1)} to {number(scale.max_c, 1)} °C."


def point(shown: PointReading, subject: Subject) -> ReadingText:
    """A point: value, photo, other modalities, depth and position."""
    reading, first = shown.reading, shown.modality
    value = deviation = ""
    lines = []
    if first is not None:
        value, deviation = _value_texts(reading.values[first], first, subject)
        if first != subject.readable[0]:
            value = f"{first.quantity} {value}"
    if first is not None and shown.photo_value is not None:
        gap = reading.values[first].value - shown.photo_value
        sign = "+" if gap >= 0 else "−"
        photo = subject.format_value(first, shown.photo_value)
        lines.append(f"photo {photo}, model {sign}{subject.format_value(first, abs(gap))}")
    for modality, other in reading.values.items():
        if modality != first:
            lines.append(" ".join((modality.quantity, *_value_texts(other, modality, subject))))
    lines.append(
        f"depth {number(reading.depth, 3)} ± {number(reading.depth_deviation, 3)} (scene units)"
    )
    lines.append("position " + ", ".join(number(each, 3) for each in reading.position))
    return {"value": value, "deviation": deviation, "lines": lines}


def mark(reading: MarkReading, reference: str, subject: Subject) -> MarkText:
    """A mark that was measured."""
    mark, temperature = reading.mark, subject.temperature
    return {
        "name": mark.name,
        "kind": mark.kind,
        "value": value_text(reading.mean, temperature, unit=True),
        "difference": ""
        if math.isnan(reading.difference)
        else f"ΔT {value_text(reading.difference, temperature, sign=True, unit=True)}",
        "lines": _mark_lines(reading, subject),
        "profile": _profile(reading),
        "note": mark.note,
        "area": mark.is_area,
        "emissivity": mark.emissivity,
        "reflected_c": mark.reflected_c,
        "reference": mark.name == reference,
    }


def _mark_lines(reading: MarkReading, subject: Subject) -> list[str]:
    """Extremes, size and photos of a mark; first of all why it has no temperature."""
    temperature = subject.temperature
    world = WorldFrame() if subject.scene is None else subject.scene.world
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


def keyframes(count: int) -> str:
    """How many keyframes a path has, and what it still needs."""
    few = {0: "No keyframes yet.", 1: "1 keyframe; add at least one more."}
    return few.get(count, f"{count} keyframes.")


def number(value: float, digits: int) -> str:
    """The number with a proper minus sign."""
    return f"{value:.{digits}f}".replace("-", "−")


def _value_texts(value: ValueReading, modality: Modality, subject: Subject) -> tuple[str, str]:
    """A value, and its standard deviation."""
    return (
        subject.format_value(modality, value.value),
        f"± {subject.format_value(modality, value.deviation)} std. dev.",
    )
