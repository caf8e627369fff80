"""Marks that stay on a model's surface: spots, lines, boxes and polygons, measured in °C and in the
scene's unit of length, and kept in the run's folder."""

from mrgs.marks.mark import Mark, Marks
from mrgs.marks.measure import MarkReading, Profile
from mrgs.marks.run_marks import RunMarks, open_marks

__all__ = ["Mark", "MarkReading", "Marks", "Profile", "RunMarks", "open_marks"]
