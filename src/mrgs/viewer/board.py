"""The marks of the model that is shown, and which part of it is, for all who look at it."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import cached_property
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
from mrgs.render import Model
from mrgs.runs.open import Run, load_run
from mrgs.scene import Camera
from mrgs.survey import SURVEY_FILE, Crop, Survey, read_survey

Listener = Callable[[], None]
Appraiser = Callable[[Survey], UncertaintyMeter]
Instruments = Callable[[], tuple[MarkPicker, Appraiser | None]]
"""What finds and measures surfaces of the model that is shown now, and their ± by a survey."""


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
        run: as it is shown at first; None for a model in training, which is shown as it is.
        show: lets a model be shown in place of the run's.

    Attributes:
        shown: the run with what is kept of it, as the survey states.
        numbers: of each; it stays the same when a mark is renamed.
        proposals: of the report, measured in the same way.
        problems: why the files of the run are not what is shown, a sentence each.
        is_measuring: whether what is shown is being measured again.
    """

    def __init__(
        self, store: MarkStore, instruments: Instruments,
        run: Run | None = None, show: Callable[[Model], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self.marks = Marks()
        self.numbers: list[int] = []
        self.readings: list[MarkReading] = []
        self.proposals: list[MarkReading] = []
        self.problems: tuple[str, ...] = ()
        self.is_measuring = False
        self._store = store
        self.shown, self._show_model, self._instruments = run, show, instruments
        self.picker, self._appraise = self._instruments()
        self.regions: Regions = self.picker.meter.regions(self.marks)
        self._identities = MarkNumbers()
        self._files: object = None
        self._listeners: tuple[Listener, ...] = ()
        try:
            survey = read_survey(self._store.folder / SURVEY_FILE)
        except MrgsError:
            survey = Survey()  # the first refresh() reports why
        self._kept: Crop | None = survey.kept
        self._use_survey(survey)
        self._measured = self.marks, self.survey

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions where a surface has an emissivity of its own, and what the ± leaves out."""
        assumed = self.picker.meter.capture.notes if self.regions else ()
        shown = any(reading.uncertainty for reading in (*self.readings, *self.proposals))
        left_out = self.uncertainty.notes if shown and self.uncertainty is not None else ()
        return (*assumed, *left_out)

    @property
    def uncertainty(self) -> UncertaintyMeter | None:
        """Uncertainty of the model's temperatures; None where it is not known."""
        return self.picker.meter.uncertainty

    def temperature(
        self,
        camera: Camera,
        depth: Float[np.ndarray, "h w"],
        pixel: tuple[int, int],
        at_once: bool,
    ) -> float:
        """What a spot at a pixel (column, row) of a picture with these z-depths would read; NaN
        where no photo sees it, the model changes, or, ``at_once``, nothing has been read yet."""
        return self.picker.temperature(camera, depth, pixel, self.regions, at_once)

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

    @cached_property
    def _whole(self) -> Run:
        """The run before anything is left out; opened again if what was given is cropped."""
        if self.shown is None:
            raise ConfigError("the model is being trained: keep a part of it when that has ended")
        run = self.shown
        return run if run.crop is None else load_run(run.folder.path, device="cpu")

    def keep(self, change: Callable[[Run], None]) -> None:
        """Change what the survey keeps of the whole run, and show that; the next refresh measures
        in it. Errors as for ``Run.keep``, and ConfigError while the run is trained."""
        change(self._whole)
        self._kept = None
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
            regions = self.picker.meter.regions(marks)
            readings = self.picker.meter.measure(marks, regions)
            proposals = self.picker.meter.measure(Marks(marks.proposals), regions)
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
        """Show what a survey keeps, and take uncertainties from what it states."""
        if self.shown is not None and survey.kept != self._kept:
            box = self._whole.box_in(survey)
            self.shown = self._whole if box is None else self._whole.cropped(box)
            self._show_model(self.shown.model)
            self.picker, self._appraise = self._instruments()
            self._kept = survey.kept
        if self._appraise is not None:
            self.picker.meter.uncertainty = self._appraise(survey)
        self.survey = survey
