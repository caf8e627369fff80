"""Marks that are measured again only where their temperature may have changed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mrgs.marks.mark import MOST_MARKS, Mark, Marks
from mrgs.marks.measure import MarkMeter, MarkReading
from mrgs.marks.regions import Regions
from mrgs.marks.uncertainty import UncertaintyMeter

MOST_REMEMBERED = 4 * MOST_MARKS


class RememberingMeter(MarkMeter):
    """Measures marks in a model that does not change, and remembers what it found: another note, a
    new name or one more mark change nothing of what the others measure. Surfaces with an emissivity
    of their own may lie on any of them, so that after a change of these all are measured again.
    """

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._own: list[tuple[str, Mark]] = []
        self._regions: Regions | None = None
        self._measured_with: tuple[Regions, UncertaintyMeter | None] | None = None
        self._readings: dict[tuple[Mark, str], MarkReading] = {}

    def regions(self, marks: Marks) -> Regions:
        """The parts of the surface with an emissivity of their own; the same object as long as
        they are the same."""
        own = [(mark.name, _surface_of(mark)) for mark in marks.marks if mark.has_settings]
        known, before = self._regions, self._own
        renamed = known is not None and known.problems and own != before  # they have names
        if known is None or renamed or [each for _, each in own] != [each for _, each in before]:
            known = self._regions = super().regions(marks)
        self._own = own  # not before: where that fails, they are still to be found
        return known

    def read(self, mark: Mark, regions: Regions | None = None) -> MarkReading:
        """One mark by itself, as it was measured before if that is still so."""
        if regions is None:
            return super().read(mark)
        measured_with = regions, self.uncertainty
        if self._measured_with != measured_with or len(self._readings) > MOST_REMEMBERED:
            self._measured_with = measured_with
            self._readings.clear()
        key = _surface_of(mark), regions.problems.get(mark.name, "")
        if key in self._readings:
            return replace(self._readings[key], mark=mark)
        reading = super().read(mark, regions)
        if not reading.problem:  # which has the mark's name
            self._readings[key] = reading
        return reading


def _surface_of(mark: Mark) -> Mark:
    """The mark without what does not change its temperature."""
    return replace(mark, name="-", note="", severity="", against="")
