"""What a browser is told, as its page reads it; all places in a picture are from 0 to 1."""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from typing import Any

from PIL import Image

from mrgs.marks.mark import (
    EMISSIVITY,
    LONGEST_NAME,
    LONGEST_NOTE,
    LONGEST_SEVERITY,
    REFLECTED_C,
)
from mrgs.marks.measure import MarkReading
from mrgs.marks.texts import MarkText, mark_text
from mrgs.pictures.drawing import Scale
from mrgs.pictures.stage import (
    PALETTE_CHOICES,
    air_facts,
    camera_facts,
    modality_facts,
    palette_facts,
)
from mrgs.pictures.values import range_of
from mrgs.scene import Modality, WorldFrame
from mrgs.viewer import texts
from mrgs.viewer.annotation import Outline, PointLabel, pane_scale, seen_marks, seen_outlines
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.inspection import DrawnPicture, Inspection
from mrgs.viewer.messages import LONGEST_SIDE_PX, VIDEO_SECONDS, Look, encode
from mrgs.viewer.panes import Pane
from mrgs.viewer.settings import Mode, Start, Subject

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


def hello_facts(inspection: Inspection, start: Start) -> dict[str, Any]:
    """All that the page must know of the model before it asks for a picture."""
    subject = inspection.subject
    return {
        "name": subject.name,
        "known": texts.header(subject),
        "start": start._asdict(),
        "modes": [_mode(mode) for mode in subject.modes],
        "views": [{"name": view.name, **camera_facts(view.camera)} for view in subject.views],
        "palettes": palette_facts([*PALETTE_CHOICES, "depth", "error"]),
        "choices": PALETTE_CHOICES,
        "modalities": [_modality(each, inspection) for each in subject.modalities],
        "marks": subject.board is not None,
        "mark_limits": MARK_LIMITS,
        "longest_side_px": LONGEST_SIDE_PX,
        "video_seconds": VIDEO_SECONDS,
        "air": {} if subject.board is None else air_facts(subject.board.survey),
    }


def _modality(modality: Modality, inspection: Inspection) -> Mapping[str, Any]:
    temperature = inspection.subject.temperature
    limits = inspection.settings.limits.get(modality, range_of(modality, temperature))
    return modality_facts(modality, temperature, limits)


def _mode(mode: Mode) -> dict[str, Any]:
    """A mode, with the controls that count in it."""
    return {
        "label": mode.label,
        "slider": mode.has_slider,
        "compares": mode.kind not in ("image", "depth", "uncertainty"),
        "scaled": None if mode.scaled is None else mode.scaled.name,
        "palette": mode.has_palette,
    }


def picture_message(inspection: Inspection, drawn: DrawnPicture, look: Look) -> bytes:
    """Length of the facts (4 bytes, little-endian), the facts as JSON, the picture as JPEG.

    Args:
        inspection: that drew the picture.
        drawn: the picture.
        look: what asked for it.
    """
    buffer = io.BytesIO()
    options = MOVING_JPEG if look.effort == "moving" else SHARP_JPEG
    Image.fromarray(drawn.pixels).save(buffer, "JPEG", **options)
    wanted = min(max(look.width, look.height), inspection.subject.source.most_pixels["still"])
    labels, outlines = inspection.marks() + inspection.proposals(), inspection.outlines()
    facts = {
        "number": look.number,
        "effort": look.effort,
        "full": max(drawn.size) >= wanted,
        "panes": [_pane(drawn, index, labels, outlines) for index in range(len(drawn.panes))],
        "photo": inspection.view_index,
    }
    header = encode(facts).encode()
    return struct.pack("<I", len(header)) + header + buffer.getvalue()


def _pane(
    drawn: DrawnPicture, index: int, labels: list[PointLabel], outlines: list[Outline]
) -> dict[str, Any]:
    """A pane, over which the page draws title, scale and marks."""
    pane, shown = drawn.panes[index], drawn.images[index]
    scale = pane_scale(pane, drawn.scales)
    return {
        "place": _place(pane, drawn.size),
        "free": pane.photo is None,
        "title": pane.title,
        "scale": None if scale is None else _scale(scale),
        "marks": seen_marks(pane, shown, labels),
        "outlines": [outline._asdict() for outline in seen_outlines(pane, shown, outlines)],
    }


def _scale(scale: Scale) -> dict[str, Any]:
    """A scale, whose numbers the page writes itself."""
    facts = scale._asdict()
    del facts["decimal"]
    return facts


def _place(pane: Pane, size: tuple[int, int]) -> list[float]:
    """Left, top, width and height of a pane."""
    width, height = size
    return [
        pane.left / width, pane.top / height,
        pane.camera.width / width,
        pane.camera.height / height,
    ]  # fmt: skip


def marks_facts(board: MarkBoard, subject: Subject) -> dict[str, Any]:
    """The marks and the proposals for the panel, as they were measured."""

    def text(reading: MarkReading) -> MarkText:
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
