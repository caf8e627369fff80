"""What is sent to a browser, as its page reads it; all places in a picture are from 0 to 1. Texts
are plain: the page shows them as text, so that nothing in them can become a tag."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Mapping
from typing import Any

import msgspec
from PIL import Image

from mrgs.marks.mark import EMISSIVITY, LONGEST_NAME, LONGEST_NOTE, LONGEST_SEVERITY, REFLECTED_C
from mrgs.marks.measure import MarkReading
from mrgs.marks.tables import mark_text
from mrgs.pictures.page_data import (
    PALETTE_CHOICES,
    air_facts,
    camera_facts,
    modality_facts,
    palette_facts,
)
from mrgs.pictures.values import range_of
from mrgs.scene import THERMAL, Modality, WorldFrame
from mrgs.system.wording import number_text
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.inspection import Inspection, PointReading
from mrgs.viewer.painting import DrawnPicture, pane_scale, seen_labels
from mrgs.viewer.panes import ValueReading
from mrgs.viewer.settings import Subject
from mrgs.viewer.source import Effort

LONGEST_SIDE_PX = 4096
VIDEO_SECONDS = 0.5, 600.0

MOVING_JPEG: dict[str, Any] = {"quality": 80}
SHARP_JPEG: dict[str, Any] = {"quality": 93, "subsampling": 0}

MARK_LIMITS = {
    "name": LONGEST_NAME,
    "note": LONGEST_NOTE,
    "severity": LONGEST_SEVERITY,
    "emissivity": EMISSIVITY,
    "reflected_c": REFLECTED_C,
}
"""Greatest lengths of a mark's texts, and the limits of its numbers."""


def hello_facts(inspection: Inspection, start: Mapping[str, Any]) -> dict[str, Any]:
    """All that the page must know of the model before it asks for a picture; ``start`` is where it
    begins, see ``start_at``."""
    subject, scale = inspection.subject, inspection.subject.temperature
    return {
        "name": subject.name,
        "known": header_text(subject),
        "start": start,
        "modes": [
            {  # with the controls that count in it
                "label": mode.label,
                "slider": mode.kind in ("blend", "split"),
                "compares": mode.kind not in ("image", "depth", "uncertainty"),
                "scaled": None if mode.scaled is None else mode.scaled.name,
                "palette": mode.scaled is not None or mode.kind == "uncertainty",
            }
            for mode in subject.modes
        ],
        "views": [{"name": view.name, **camera_facts(view.camera)} for view in subject.views],
        "palettes": palette_facts([*PALETTE_CHOICES, "depth", "error"]),
        "choices": PALETTE_CHOICES,
        "palette": inspection.settings.palette,
        "modalities": [
            modality_facts(each, scale, inspection.settings.limits.get(each, range_of(each, scale)))
            for each in subject.modalities
        ],
        "marks": subject.board is not None,
        "keeps": subject.board is not None and subject.board.shown is not None,
        "mark_limits": MARK_LIMITS,
        "longest_side_px": LONGEST_SIDE_PX,
        "video_seconds": VIDEO_SECONDS,
        "air": {} if subject.board is None else air_facts(subject.board.survey),
    }


def picture_message(
    inspection: Inspection, drawn: DrawnPicture, number: int, effort: Effort, longest_px: int
) -> bytes:
    """Length of the facts (4 bytes, little-endian), the facts as JSON, the picture as JPEG.
    ``longest_px`` is the longer side of the browser's window, in pixels of the screen."""
    buffer = io.BytesIO()
    options = MOVING_JPEG if effort == "moving" else SHARP_JPEG
    Image.fromarray(drawn.pixels).save(buffer, "JPEG", **options)
    wanted = min(longest_px, inspection.subject.source.most_pixels["still"])
    labels, (width, height), panes = inspection.labels(with_proposals=True), drawn.size, []
    for pane, shown in zip(drawn.panes, drawn.images, strict=True):
        place = (pane.left / width, pane.top / height)
        scale, seen = pane_scale(pane, drawn.scales), seen_labels(pane, shown, labels)
        scale_facts = None if scale is None else scale._asdict()
        if scale_facts is not None:
            del scale_facts["decimal"]  # the page writes the numbers itself
        panes.append(
            {  # over which the page draws title, scale and marks
                "place": [*place, pane.camera.width / width, pane.camera.height / height],
                "free": pane.photo is None,
                "title": pane.title,
                "scale": scale_facts,
                "marks": [(*e.corners[0], e.label, e.short) for e in seen if len(e.corners) == 1],
                "outlines": [each._asdict() for each in seen if len(each.corners) > 1],
            }
        )
    facts = {
        "number": number,
        "effort": effort,
        "full": max(drawn.size) >= wanted,
        "panes": panes,
        "photo": inspection.view_index,
    }
    header = encode(facts).encode()
    return struct.pack("<I", len(header)) + header + buffer.getvalue()


def marks_facts(board: MarkBoard, subject: Subject) -> dict[str, Any]:
    """The marks and the proposals for the panel, as they were measured."""

    def text(reading: MarkReading) -> dict[str, Any]:
        return mark_text(reading, board.marks.reference, subject.temperature, world)

    world = WorldFrame() if subject.scene is None else subject.scene.world
    return {
        "of": [
            {"id": number, **text(reading)}
            for number, reading in zip(board.numbers, board.readings, strict=True)
        ],
        "proposals": [text(reading) for reading in board.proposals],
        "notes": board.notes,
        "problems": board.problems,
    }


def header_text(subject: Subject) -> str:
    """The temperature range, or why there is none."""
    scale = subject.temperature
    if THERMAL not in subject.modalities:
        shown = ", ".join(modality.quantity for modality in subject.modalities)
        return f"No thermal photos: {shown} and depth only."
    if scale is None:
        return "This scene has no known °C: temperatures are normalised, 0 to 1."
    return f"Recorded range {number_text(scale.min_c, 1)} to {number_text(scale.max_c, 1)} °C."


def point_text(shown: PointReading, subject: Subject) -> dict[str, Any]:
    """A point that was read: the value in large type, its deviation, and further lines with photo,
    other modalities, depth and position."""
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


def _value_texts(value: ValueReading, modality: Modality, subject: Subject) -> tuple[str, str]:
    """A value, and its standard deviation."""
    return (
        subject.format_value(modality, value.value),
        f"± {subject.format_difference(modality, value.deviation)} std. dev.",
    )


def encode(value: object) -> str:
    """A message to a browser as JSON; ? stands for what is not UTF-8 in the name of a file."""
    try:
        return msgspec.json.encode(value, enc_hook=str).decode()  # a Message is a text
    except UnicodeEncodeError:
        text = json.dumps(value, default=str, ensure_ascii=False).encode("utf-8", "replace")
        return msgspec.json.encode(json.loads(text)).decode()
