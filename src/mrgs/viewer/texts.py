"""The panel's texts as HTML; anything that comes from files is escaped."""

from __future__ import annotations

import html
from collections.abc import Sequence

from mrgs.viewer.inspection import Inspection
from mrgs.viewer.picking import BoxReading
from mrgs.viewer.settings import Subject

_STYLE = "font-size:13px;line-height:1.45;padding:2px 12px 6px 12px"
CLICK_HINT = "Click on the picture to read a point."
EMPTY_HINT = "Nothing there: the model is empty at this point. Click on something solid."


def paragraph(text: str, color: str = "inherit") -> str:
    """One escaped line of text."""
    return f'<div style="{_STYLE};color:{color};overflow-wrap:anywhere">{html.escape(text)}</div>'


def header(subject: Subject, note: str) -> str:
    """What is known of the temperatures, and the note."""
    scale = subject.temperature
    if not subject.has_thermal:
        known = "No thermal photos: colour and depth only."
    elif scale is None:
        known = "This scene has no known °C: temperatures are normalised, 0 to 1."
    else:
        known = f"The cameras' range: {_number(scale.min_c, 1)} to {_number(scale.max_c, 1)} °C."
    lines = [html.escape(known)]
    if note:
        lines.append(f'<span style="color:#c2410c">{html.escape(note)}</span>')
    return f'<div style="{_STYLE}">{"<br>".join(lines)}</div>'


def point(inspection: Inspection) -> str:
    """The point that was read last."""
    shown = inspection.point
    if shown is None:
        return _block(html.escape(CLICK_HINT), "mrgs-hint")
    reading, subject = shown.reading, inspection.subject
    lines = []
    if reading.value is not None and reading.value_spread is not None:
        spread = subject.format_value(reading.value_spread)
        big = (
            f'<span class="mrgs-value" '
            f'style="font-size:22px;font-weight:600">{subject.format_value(reading.value)}'
        )
        unit = " (normalised)" if subject.temperature is None else ""
        lines.append(f"{big}</span> <span>± {spread} spread{unit}</span>")
    if shown.photo_value is not None and reading.value is not None:
        gap = reading.value - shown.photo_value
        sign = "+" if gap >= 0 else "−"
        photo = subject.format_value(shown.photo_value)
        lines.append(f"photo {photo}, model {sign}{subject.format_value(abs(gap))}")
    lines.append(f"depth {reading.depth:.3f} ± {reading.depth_spread:.3f} (scene units)")
    lines.append("position " + ", ".join(_number(value, 3) for value in reading.position))
    return _block("<br>".join(lines), "mrgs-reading")


def _block(content: str, name: str) -> str:
    """As high with a hint as with a reading, so that the controls below do not jump."""
    return f'<div style="{_STYLE};min-height:96px" class="{name}">{content}</div>'


def spots(inspection: Inspection) -> str:
    """The spots that were kept, one line each."""
    if not inspection.spots:
        return paragraph("No spots yet.", "#6b7280")
    lines = [
        html.escape(spot.label) + " at " + ", ".join(_number(value, 2) for value in spot.position)
        for spot in inspection.spots
    ]
    return f'<div style="{_STYLE}" class="mrgs-spots">{"<br>".join(lines)}</div>'


def boxes(readings: Sequence[BoxReading | None], subject: Subject) -> str:
    """Minimum, mean and maximum of each box, as a table."""
    if not readings:
        return paragraph("No boxes yet.", "#6b7280")
    rows = "".join(
        _box_row(f"B{number}", reading, subject) for number, reading in enumerate(readings, start=1)
    )
    unit = subject.unit
    head = f"<tr><th></th><th>min</th><th>mean</th><th>max</th><th>{unit}</th></tr>"
    table = f'<table class="mrgs-boxes" style="width:100%;text-align:right">{head}{rows}</table>'
    return f'<div style="{_STYLE}">{table}</div>'


def _number(value: float, digits: int) -> str:
    """The number with a proper minus sign."""
    return f"{value:.{digits}f}".replace("-", "−")


def _box_row(name: str, reading: BoxReading | None, subject: Subject) -> str:
    if reading is None:
        return f'<tr><td>{name}</td><td colspan="4">no temperatures in it</td></tr>'
    digits = 3 if subject.temperature is None else 1
    figures = (reading.lowest.value, reading.mean, reading.highest.value)
    cells = "".join(f"<td>{_number(figure, digits)}</td>" for figure in figures)
    return f"<tr><td>{name}</td>{cells}<td></td></tr>"
