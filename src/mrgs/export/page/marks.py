"""The marks of a run for the page: what was measured, and where to draw it."""

from __future__ import annotations

from typing import Any, TypeAlias

from mrgs.marks.mark import Place
from mrgs.marks.run_marks import RunMarks
from mrgs.marks.tables import corrected_text
from mrgs.marks.texts import label_text, mark_text

PageMark: TypeAlias = dict[str, Any]
"""``MarkText``, with the places of the mark and its label in the picture."""


def page_marks(marks: RunMarks) -> tuple[list[PageMark], tuple[str, ...]]:
    """The marks of a run, and what was assumed for their uncertainties and for surfaces with an
    emissivity of their own.

    Raises:
        RunError: ``marks.json`` holds the marks of another model.
    """
    known, temperature = marks.marks, marks.run.temperature
    if not len(known):
        return [], ()
    shown = []
    for reading in marks.meter.measure(known):
        mark, text = reading.mark, mark_text(reading, known.reference, temperature, marks.world)
        # An area's own settings are in no field here.
        corrected = [corrected_text(reading)] if mark.has_settings and not reading.problem else []
        shown.append(
            {
                **text,
                "lines": [*text["lines"], *corrected],
                "points": [_rounded(point) for point in mark.points],
                "closed": mark.is_area,
                "lowAt": list(reading.low_at) or None,
                "highAt": list(reading.high_at) or None,
                "label": label_text(reading, temperature),
            }
        )
    of_uncertainty = () if marks.meter.uncertainty is None else marks.meter.uncertainty.notes
    has_own = any(mark.has_settings for mark in known.marks)
    return shown, (*of_uncertainty, *(marks.meter.capture.notes if has_own else ()))


def _rounded(point: Place) -> list[float]:
    return [round(each, 6) for each in point]
