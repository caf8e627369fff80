"""What the panel says, as plain text: the page shows it as text, so that nothing in it can become
a tag."""

from __future__ import annotations

from typing import TypedDict

from mrgs.pictures.numbers import number_text
from mrgs.scene import THERMAL, Modality, WorldFrame
from mrgs.viewer.inspection import PointReading
from mrgs.viewer.picking import ValueReading
from mrgs.viewer.settings import Subject

EMPTY_HINT = "Nothing there: the model is empty at this point."


class ReadingText(TypedDict):
    """A point that was read: the value in large type, its deviation, and further lines."""

    value: str
    deviation: str
    lines: list[str]


def header(subject: Subject) -> str:
    """The temperature range, or why there is none."""
    scale = subject.temperature
    if THERMAL not in subject.modalities:
        shown = ", ".join(modality.quantity for modality in subject.modalities)
        return f"No thermal photos: {shown} and depth only."
    if scale is None:
        return "This scene has no known °C: temperatures are normalised, 0 to 1."
    return f"Recorded range {number_text(scale.min_c, 1)} to {number_text(scale.max_c, 1)} °C."


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
        photo = subject.format_value(first, shown.photo_value)
        lines.append(f"photo {photo}, model {subject.format_difference(first, gap, sign=True)}")
    for modality, other in reading.values.items():
        if modality != first:
            lines.append(" ".join((modality.quantity, *_value_texts(other, modality, subject))))
    world = WorldFrame() if subject.scene is None else subject.scene.world
    depth, around = (number_text(each, 3) for each in (reading.depth, reading.depth_deviation))
    lines.append(f"depth {depth} ± {around} {world.length_unit}")
    lines.append("position " + ", ".join(number_text(each, 3) for each in reading.position))
    return {"value": value, "deviation": deviation, "lines": lines}


def keyframes(count: int) -> str:
    """How many keyframes a path has, and what it still needs."""
    few = {0: "No keyframes yet.", 1: "1 keyframe; add at least one more."}
    return few.get(count, f"{count} keyframes.")


def _value_texts(value: ValueReading, modality: Modality, subject: Subject) -> tuple[str, str]:
    """A value, and its standard deviation."""
    return (
        subject.format_value(modality, value.value),
        f"± {subject.format_difference(modality, value.deviation)} std. dev.",
    )
