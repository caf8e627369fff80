"""The marks of the model that is shown, for all browsers that look at it."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from mrgs.errors import ConfigError, MrgsError, MrgsWarning
from mrgs.marks.mark import Mark, Marks
from mrgs.marks.measure import MarkReading
from mrgs.marks.regions import Regions
from mrgs.marks.run_marks import MarkPicker
from mrgs.marks.store import MarkStore, file_stamp
from mrgs.marks.uncertainty import UncertaintyMeter
from mrgs.scene import Camera
from mrgs.survey import SURVEY_FILE, Survey, read_survey
from mrgs.viewer.keeping import Keeping

Listener = Callable[[], None]
Appraiser = Callable[[Survey], UncertaintyMeter]
Instruments = tuple[MarkPicker, Appraiser | None]


class MarkNumbers:
    """Numbers by which a page knows marks; renaming, by whatever program, keeps a mark's."""

    def __init__(self) -> None:
        self._known: dict[int, Mark] = {}
        self._unused = itertools.count(1)

    def of(self, marks: Sequence[Mark]) -> list[int]:
        """The number of each mark: that of the known mark with its name and place, else of one at
        its place, else a new one."""

        def place(mark: Mark) -> Hashable:
            return mark.kind, mark.points, mark.eye

        found: dict[int, int] = {}
        for key in (lambda mark: (mark.name, place(mark)), place):
            known = self._known.items()
            left = {key(mark): number for number, mark in known if number not in found.values()}
            for index, mark in enumerate(marks):
                if index not in found and key(mark) in left:
                    found[index] = left.pop(key(mark))
        numbers = [
            found[index] if index in found else next(self._unused) for index in range(len(marks))
        ]
        self._known = dict(zip(numbers, marks, strict=True))
        return numbers


class MarkBoard:
    """The marks on the disk, as they were measured last; to be called where the model may be used,
    see ``Worker``.

    Args:
        instruments: make what finds the surface that marks are drawn on, with the meter that
            measures them, and what finds the uncertainty of the temperatures by what the survey
            states, None if unknown; for the model as it is shown.
        keeping: follows the survey; None for a model that is shown as it is.

    Attributes:
        numbers: of each; it stays the same when a mark is renamed.
        proposals: of the report, measured in the same way.
        problems: why the files of the run are not what is shown, a sentence each.
        is_measuring: whether what is shown is being measured again.
    """

    def __init__(
        self,
        store: MarkStore,
        instruments: Callable[[], Instruments],
        keeping: Keeping | None = None,
    ) -> None:
        self.marks = Marks()
        self.numbers: list[int] = []
        self.readings: list[MarkReading] = []
        self.proposals: list[MarkReading] = []
        self._instruments, self._keeping = instruments, keeping
        self._use_instruments()
        self.regions: Regions = self._meter.regions(self.marks)
        self.problems: tuple[str, ...] = ()
        self.is_measuring = False
        self._store = store
        self._identities = MarkNumbers()
        self._files: object = None
        self._listeners: tuple[Listener, ...] = ()
        try:
            survey = read_survey(self._store.folder / SURVEY_FILE)
        except MrgsError:
            survey = Survey()  # the first refresh() reports why
        self._use_survey(survey)
        self._measured = self.marks, self.survey

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions where a surface has an emissivity of its own, and what the ± leaves out."""
        assumed = self._meter.capture.notes if self.regions else ()
        shown = any(reading.uncertainty for reading in (*self.readings, *self.proposals))
        left_out = self.uncertainty.notes if shown and self.uncertainty is not None else ()
        return (*assumed, *left_out)

    @property
    def uncertainty(self) -> UncertaintyMeter | None:
        """Uncertainty of the model's temperatures; None where it is not known."""
        return self._meter.uncertainty

    def temperature(
        self,
        camera: Camera,
        depth: Float[np.ndarray, "h w"],
        pixel: tuple[int, int],
        at_once: bool,
    ) -> float:
        """What a spot at a pixel (column, row) of a picture with these z-depths would read; NaN
        where no photo sees it, the model changes, or, ``at_once``, nothing has been read yet."""
        if at_once and not self._meter.survey.maps:
            return np.nan
        return self.picker.temperature(camera, depth, pixel, self.regions)

    def subscribe(self, listener: Listener) -> None:
        """Call a function after each change; to be called by one thread, as ``unsubscribe``."""
        self._listeners = (*self._listeners, listener)

    def unsubscribe(self, listener: Listener) -> None:
        """No longer call a function after each change."""
        self._listeners = tuple(each for each in self._listeners if each != listener)

    @property
    def is_stale(self) -> bool:
        """Whether the files of the run have changed since they were read."""
        return self._files != self._files_now()

    def refresh(self) -> None:
        """Measure what another program has changed; unreadable files change only ``problems``."""
        if not self.is_stale:
            return
        self._files = self._files_now()
        before = self.problems
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", MrgsWarning)
            try:
                marks, survey = self._store.read(), read_survey(self._store.folder / SURVEY_FILE)
                if survey != self.survey:
                    self._use_survey(survey)
                if (marks, survey) == self._measured:
                    self.problems = ()
                else:
                    self._measure(marks, problems=())
            except MrgsError as error:
                self.problems = (str(error),)
        if caught:  # of a damaged file, which reading has moved away
            self.problems = (*self.problems, *(str(each.message) for each in caught))
            self._files = self._files_now()
        if self.problems != before:
            for listener in self._listeners:
                listener()

    def show_kept(self) -> None:
        """Notify of what is to be shown now; the next ``refresh`` measures in it. Errors as for
        ``read_survey``."""
        self._use_survey(read_survey(self._store.folder / SURVEY_FILE))
        self._files, self._measured = None, (Marks(), Survey())
        for listener in self._listeners:
            listener()

    def change(self, number: int, fields: dict[str, Any]) -> None:
        """Change fields of the mark of a number; errors as for ``edit``."""
        self.edit(lambda marks: marks.changing(self._name(marks, number), **fields))

    def delete(self, number: int) -> None:
        """Delete the mark of a number; errors as for ``edit``."""
        self.edit(lambda marks: marks.without(self._name(marks, number)))

    def refer_to(self, number: int | None) -> None:
        """Let all differences refer to the mark of a number, or to none; errors as for ``edit``."""

        def change(marks: Marks) -> Marks:
            return replace(marks, reference="" if number is None else self._name(marks, number))

        self.edit(change)

    def edit(self, change: Callable[[Marks], Marks]) -> None:
        """Change the marks, save, measure and notify. ConfigError if the change is not possible,
        RunError if it cannot be saved."""
        self._measure(self._store.edit(change), self.problems)
        self._files = None

    def undo(self) -> None:
        """Undo the last change; errors as for ``edit``."""
        self._measure(self._store.undo(), self.problems)
        self._files = None

    def _measure(self, marks: Marks, problems: tuple[str, ...]) -> None:
        """Measure marks that have been saved, and notify before and after. If that fails, it is a
        problem in place of the known ones, and no error of the change, which has been saved."""
        self.is_measuring = True
        for listener in self._listeners:
            listener()
        try:
            regions = self._meter.regions(marks)
            readings = self._meter.measure(marks, regions)
            proposals = self._meter.measure(Marks(marks.proposals), regions)
            self.regions, self.readings, self.proposals = regions, readings, proposals
            self.marks, self.numbers = marks, self._identities.of(marks.marks)
            self._measured, self.problems = (marks, self.survey), problems
        except MrgsError as error:
            self.problems = (str(error),)
        finally:
            self.is_measuring = False
        for listener in self._listeners:
            listener()

    def _name(self, marks: Marks, number: int) -> str:
        """Present name of the mark of a number on the disk."""
        numbers = self._identities.of(marks.marks)
        if number not in numbers:
            raise ConfigError("this mark has been deleted")
        return marks.marks[numbers.index(number)].name

    def _files_now(self) -> object:
        folder = self._store.folder
        there = file_stamp(folder) is not None
        return there, self._store.stamp, file_stamp(folder / SURVEY_FILE)

    def _use_survey(self, survey: Survey) -> None:
        """Show what a survey keeps, and take uncertainties from what it states. ConfigError if it
        keeps nothing."""
        if self._keeping is not None and self._keeping.follow(survey):
            self._use_instruments()
        if self._appraise is not None:
            self._meter.uncertainty = self._appraise(survey)
        self.survey = survey

    def _use_instruments(self) -> None:
        """Measure in the model as it is shown now."""
        self.picker, self._appraise = self._instruments()
        self._meter = self.picker.meter
