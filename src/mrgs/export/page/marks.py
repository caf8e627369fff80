"""The marks of a run for the page: what was measured, and where to draw it."""

from __future__ import annotations

from typing import Any, TypeAlias

from mrgs.marks import open_marks
from mrgs.marks.mark import Place
from mrgs.marks.texts import label_text, mark_text
from mrgs.runs.open import Run
from mrgs.scene import Scene

PageMark: TypeAlias = dict[str, Any]
"""``MarkText``, with the places of the mark and its label in the picture."""


def page_marks(run: Run, scene: Scene) -> tuple[list[PageMark], tuple[str, ...]]:
    """The marks of a run, and what was assumed for surfaces with an emissivity of their own.

    Raises:
        RunError: ``marks.json`` holds the marks of another model.
    """
    marks = open_marks(run, scene)
    known = marks.marks
    if not len(known):
        return [], ()
    shown = []
    for reading in marks.meter.measure(known):
        mark = reading.mark
        shown.append(
            {
                **mark_text(reading, known.reference, run.temperature, marks.world),
                "points": [_rounded(point) for point in mark.points],
                "closed": mark.is_area,
                "lowAt": list(reading.low_at) or None,
                "highAt": list(reading.high_at) or None,
                "label": label_text(reading, run.temperature),
            }
        )
    has_own = any(mark.has_settings for mark in known.marks)
    return shown, marks.meter.capture.notes if has_own else ()


def _rounded(point: Place) -> list[float]:
    return [round(each, 6) for each in point]
