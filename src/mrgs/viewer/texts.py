"""The panel's texts as HTML; text that comes from files is escaped."""

from __future__ import annotations

import html
from collections.abc import Sequence

from mrgs.pictures.values import NORMALISED, decimals_of, unit_of
from mrgs.scene import Modality
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.picking import BoxReading, ValueReading
from mrgs.viewer.settings import Subject

_STYLE = "font-size:13px;line-height:1.45;padding:2px 12px 6px 12px"
CLICK_HINT = "Click on the picture to read a point."
EMPTY_HINT = "Nothing there: the model is empty at this point. Click on something solid."


def paragraph(text: str, color: str = "inherit") -> str:
    """A line of text as an HTML paragraph, escaped."""
    return f'<div style="{_STYLE};color:{color};overflow-wrap:anywhere">{html.escape(text)}</div>'


def header(subject: Subject, note: str) -> str:
    """The temperature range, or why there is none, and the note."""
    scale = subject.temperature
    if not subject.has_thermal:
        shown = ", ".join(modality.quantity for modality in subject.modalities)
        known = f"No thermal photos: {shown} and depth only."
    elif scale is None:
        known = "This scene has no known °C: temperatures are normalised, 0 to 1."
    else:
        known = f"The cameras' range: {_number(scale.min_c, 1)} to {_number(scale.max_c, 1)} °C."
    lines = [html.escape(known)]
    if note:
        lines.append(f'<span style="color:#c2410c">{html.escape(note)}</span>')
    return f'<div style="{_STYLE}">{"<br>".join(lines)}</div>'


def point(inspection: Inspection) -> str:
    """The point that was read last: value, photo, other modalities, depth and position."""
    shown, subject = inspection.point, inspection.subject
    if shown is None:
        return _block(html.escape(CLICK_HINT), "mrgs-hint", subject)
    reading, first = shown.reading, shown.modality
    lines = []
    if first is not None:
        lines.append(_value_line(reading.values[first], first, subject))
    if first is not None and shown.photo_value is not None:
        gap = reading.values[first].value - shown.photo_value
        sign = "+" if gap >= 0 else "−"
        photo = _text(first, shown.photo_value, subject)
        lines.append(f"photo {photo}, model {sign}{_text(first, abs(gap), subject)}")
    for modality, other in reading.values.items():
        if modality != first:
            name = html.escape(modality.quantity)
            lines.append(
                f"{name} {_text(modality, other.value, subject)} "
                f"± {_text(modality, other.deviation, subject)}"
            )
    lines.append(f"depth {reading.depth:.3f} ± {reading.depth_deviation:.3f} (scene units)")
    lines.append("position " + ", ".join(_number(value, 3) for value in reading.position))
    return _block("<br>".join(lines), "mrgs-reading", subject)


def _value_line(value: ValueReading, modality: Modality, subject: Subject) -> str:
    """A value in large type, with its standard deviation; named if it is not the default one."""
    name = "" if modality == subject.readable[0] else f"{html.escape(modality.quantity)} "
    unit = unit_of(modality, subject.temperature)
    suffix = f" ({unit})" if unit == NORMALISED else ""
    return (
        f'{name}<span class="mrgs-value" style="font-size:22px;font-weight:600">'
        f"{_text(modality, value.value, subject)}</span> "
        f"<span>± {_text(modality, value.deviation, subject)} std. dev.{suffix}</span>"
    )


def _text(modality: Modality, value: float, subject: Subject) -> str:
    """A value with its unit, escaped: units may come from a file."""
    return html.escape(subject.format_value(modality, value))


def _block(content: str, name: str, subject: Subject) -> str:
    """As high with a hint as with a reading, so that the controls below do not jump."""
    height = 76 + 20 * max(len(subject.readable), 1)
    return f'<div style="{_STYLE};min-height:{height}px" class="{name}">{content}</div>'


def spots(inspection: Inspection) -> str:
    """The spots that were kept, one line each."""
    if not inspection.spots:
        return paragraph("No spots yet.", "#6b7280")
    lines = [
        html.escape(spot.label) + " at " + ", ".join(_number(value, 2) for value in spot.position)
        for spot in inspection.spots
    ]
    return f'<div style="{_STYLE}" class="mrgs-spots">{"<br>".join(lines)}</div>'


def boxes(
    readings: Sequence[BoxReading | None], modality: Modality | None, subject: Subject
) -> str:
    """Minimum, mean and maximum of a modality in each box, as a table."""
    if not readings or modality is None:
        return paragraph("No boxes yet.", "#6b7280")
    digits = decimals_of(modality, subject.temperature)
    rows = "".join(
        _box_row(f"B{number}", reading, digits, modality.quantity)
        for number, reading in enumerate(readings, start=1)
    )
    unit = html.escape(unit_of(modality, subject.temperature))
    head = f"<tr><th></th><th>min</th><th>mean</th><th>max</th><th>{unit}</th></tr>"
    table = f'<table class="mrgs-boxes" style="width:100%;text-align:right">{head}{rows}</table>'
    return f'<div style="{_STYLE}">{table}</div>'


def _number(value: float, digits: int) -> str:
    """The number with a proper minus sign."""
    return f"{value:.{digits}f}".replace("-", "−")


def _box_row(name: str, reading: BoxReading | None, digits: int, quantity: str) -> str:
    if reading is None:
        return f'<tr><td>{name}</td><td colspan="4">no {html.escape(quantity)} in it</td></tr>'
    figures = (reading.lowest.value, reading.mean, reading.highest.value)
    cells = "".join(f"<td>{_number(figure, digits)}</td>" for figure in figures)
    return f"<tr><td>{name}</td>{cells}<td></td></tr>"
