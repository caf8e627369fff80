"""The marks of a run for all who look at it, whoever changes its files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace

import pytest

from mrgs.errors import ConfigError, RunError
from mrgs.marks import Mark
from mrgs.marks.store import MarkStore
from mrgs.render import Model
from mrgs.scene import Box, Camera
from mrgs.survey import SURVEY_FILE, Survey, write_survey
from mrgs.viewer.board import MarkBoard, MarkNumbers
from mrgs.viewer.server import board_of
from mrgs.viewer.source import Result, TrainedSource
from tests.helpers.subjects import subject_of


@pytest.fixture
def board(subject) -> MarkBoard:
    return subject.board


@pytest.fixture
def disk(board) -> MarkStore:
    """The same file, as another program opens it."""
    return MarkStore(board._store.folder, board._store._spread)


@pytest.fixture
def add(board, camera):
    """Adds a box about a place of the picture; returns its number."""

    def add_box(x: float = 80.0, y: float = 60.0) -> int:
        picked = board.picker.pick("box", camera, [(x - 4, y - 4), (x + 5, y + 5)])
        board.edit(lambda marks: marks.adding("box", **picked))
        return board.numbers[-1]

    return add_box


class FailingSource(TrainedSource):
    """A model that nothing can be measured in while ``failure`` is set."""

    failure = ""

    def run(self, job: Callable[[Model], Result], moving: Camera | None = None) -> Result:
        if self.failure:
            raise RunError(self.failure)
        return super().run(job, moving)


def test_a_mark_keeps_its_number_when_it_is_renamed_here_or_elsewhere(board, disk, add):
    first, second = add(), add(84.0)
    board.change(first, {"name": "Door"})
    disk.edit(lambda marks: marks.changing("Door", name="Gate"))
    board.change(first, {"note": "warm"})
    disk.edit(lambda marks: marks.without("B2"))
    board.refresh()
    assert board.numbers == [first]
    assert (board.marks.marks[0].name, board.marks.marks[0].note) == ("Gate", "warm")
    with pytest.raises(ConfigError, match="deleted"):
        board.delete(second)


def test_marks_at_one_place_are_told_apart_by_their_names():
    numbers = MarkNumbers()
    mark = Mark("A", "spot", ((0.0, 0.0, 0.0),), (0.0, -5.0, 0.0), radius=0.01)
    same = replace(mark, name="B")
    first, second = numbers.of([mark, same])
    assert numbers.of([same]) == [second]
    assert numbers.of([replace(same, name="C"), mark]) == [second, 3]
    assert first == 1


def test_a_change_of_one_field_leaves_what_another_program_wrote(board, disk, add):
    number = add()
    disk.edit(lambda marks: marks.changing("B1", note="from elsewhere", emissivity=0.9))
    board.change(number, {"severity": "2"})
    (mark,) = disk.read().marks
    assert (mark.note, mark.emissivity, mark.severity) == ("from elsewhere", 0.9, "2")


def test_what_another_program_does_is_found_and_told(board, disk, add):
    add()
    board.refresh()
    told: list[tuple[int, bool]] = []
    board.subscribe(lambda: told.append((len(board.marks), board.is_measuring)))
    assert not board.is_stale
    disk.edit(lambda marks: marks.without("B1"))
    assert board.is_stale
    board.refresh()
    board.refresh()
    assert told == [(1, True), (0, False)]


def test_a_file_that_is_deleted_right_after_a_change_is_noticed(board, disk, add):
    board.refresh()
    add()
    disk.file.unlink()
    board.refresh()
    assert len(board.marks) == 0


def test_the_uncertainty_follows_the_survey(board, add):
    add()
    before = board.readings[0].uncertainty.total
    assert any("accuracy" in note for note in board.notes)
    (board._store.folder / SURVEY_FILE).write_text("camera_accuracy_c: 5")
    board.refresh()
    assert board.readings[0].uncertainty.total > before
    assert board.readings[0].uncertainty.known["camera"] == pytest.approx(0.95 * 5)
    assert not any("accuracy" in note for note in board.notes)


def test_files_that_cannot_be_read_leave_the_marks_and_say_why(board, disk, add):
    add()
    told: list[tuple[str, ...]] = []
    board.subscribe(lambda: told.append(board.problems))
    survey = board._store.folder / SURVEY_FILE
    survey.write_text("camera_accuracy_c: a lot")
    board.refresh()
    survey.unlink()
    board.refresh()
    document = json.loads(disk.file.read_text(encoding="utf-8"))
    disk.file.write_text(json.dumps({**document, "version": 99}), encoding="utf-8")
    board.refresh()
    assert len(board.marks) == 1
    assert ["camera_accuracy_c" in "".join(each) for each in told] == [True, False, False]
    assert [bool(each) for each in told] == [True, False, True]
    assert "newer version" in board.problems[0]


def test_a_broken_survey_is_a_problem_and_no_reason_not_to_open(board, disk, add):
    add()
    survey = disk.folder / SURVEY_FILE
    survey.write_text("camera_accuracy_c: a lot")
    opened = MarkBoard(disk, board._instruments)
    opened.refresh()
    assert "camera_accuracy_c" in opened.problems[0]
    survey.unlink()
    opened.refresh()
    assert (len(opened.readings), opened.problems) == (1, ())


def test_a_change_is_saved_though_it_cannot_be_measured(subject, disk, add, small_run):
    add()
    source = FailingSource(small_run.model)
    board = board_of(replace(subject, source=source), disk._spread)
    board.refresh()
    before = board.readings[0].mean
    told: list[tuple[str, ...]] = []
    board.subscribe(lambda: told.append(board.problems))
    source.failure = "x.jpg is torn"
    board.change(board.numbers[0], {"emissivity": 0.6, "reflected_c": 0.0})
    board.refresh()
    (disk.folder / SURVEY_FILE).write_text("camera_accuracy_c: 5")
    board.refresh()
    assert not board.is_measuring
    assert set(told[1:]) == {("x.jpg is torn",)}
    assert disk.read().marks[0].emissivity == 0.6
    source.failure = ""
    board.change(board.numbers[0], {"severity": "2"})
    board.refresh()
    assert (board.readings[0].mark.emissivity, board.problems) == (0.6, ())
    assert board.readings[0].mean > before + 1
    assert not any("accuracy" in note for note in board.notes)


def test_a_file_that_is_replaced_within_a_tick_of_the_clock_is_noticed(board, disk, add):
    add()
    board.refresh()
    before = disk.file.stat()
    other = disk.file.with_name("marks.other.json")
    other.write_text(disk.file.read_text(encoding="utf-8").replace("B1", "B2"), encoding="utf-8")
    os.utime(other, ns=(before.st_atime_ns, before.st_mtime_ns))
    other.rename(disk.file)
    assert disk.file.stat().st_mtime_ns == before.st_mtime_ns
    assert board.is_stale


def test_a_damaged_file_is_said_as_long_as_nothing_changes(board, disk, add):
    add(), add(84.0)
    disk.file.write_text("{")
    board.refresh()
    board.refresh()
    assert "kept as marks.json.damaged" in board.problems[0]
    board.undo()
    board.refresh()
    assert (len(board.marks), board.problems) == (1, ())


def test_a_run_that_is_gone_is_not_made_anew(board, disk, add):
    number = add()
    folder = board._store.folder
    away = folder.rename(folder.with_name("away"))
    for change in (lambda: board.change(number, {"note": "x"}), board.undo, add):
        with pytest.raises(RunError, match="is gone"):
            change()
    board.refresh()
    assert not folder.exists()
    assert len(board.marks) == 1
    assert "is gone" in board.problems[0]
    away.rename(folder)
    board.refresh()
    assert board.problems == ()
    board.change(number, {"note": "x"})


def test_only_what_a_change_can_affect_is_measured(board, disk, add):
    number, other = add(), add(84.0)
    before = [reading.uncertainty for reading in board.readings]

    def measured_anew() -> list[bool]:
        found = zip(board.readings, before, strict=False)
        return [reading.uncertainty is not known for reading, known in found]

    board.change(number, {"note": "a"})
    board.change(number, {"name": "Door", "severity": "2"})
    board.refer_to(other)
    disk.edit(lambda marks: marks.changing("B2", note="b"))
    board.refresh()
    assert measured_anew() == [False, False]
    assert board.readings[0].mark.note == "a"
    assert board.readings[0].difference == board.readings[0].mean - board.readings[1].mean
    add(76.0)
    assert measured_anew() == [False, False]
    board.change(number, {"emissivity": 0.6, "reflected_c": 0.0})
    assert measured_anew() == [True, True]


def test_what_is_missing_is_said_of_the_mark_by_its_name(board, add):
    number = add()
    board.change(number, {"emissivity": 0.6})
    problem = board.readings[0].problem
    assert problem.startswith("B1: ")
    assert "reflected temperature" in problem
    board.change(number, {"name": "Door"})
    assert board.readings[0].problem == problem.replace("B1", "Door")
    board.change(number, {"reflected_c": 0.0})
    assert board.readings[0].problem == ""


def test_a_problem_has_the_name_that_the_mark_has_now(board):
    ends = ((2.9, -4.0, 0.0), (2.9, 4.0, 0.0))  # farther apart than anything sees from so near
    line = Mark("L1", "line", ends, (3.0, 0.0, 0.0))
    board.edit(lambda marks: marks.adding(**vars(line)))
    problem = board.readings[0].problem
    assert problem.startswith("L1 ")
    board.change(board.numbers[0], {"name": "Door"})
    assert board.readings[0].problem == problem.replace("L1", "Door")


@pytest.fixture
def left(board):
    """A box with nearly all that is at y below 0."""
    (x0, y0, z0), (x1, _, z1) = board.shown.model.gaussians.means.aminmax(dim=0)
    return Box.between(*map(float, (x0, y0, z0, x1, 0.0, z1)))


def count(board) -> int:
    return board._instruments.args[0].source.run(lambda model: len(model.gaussians))


def test_what_is_kept_is_shown_at_once_and_undone(board, left):
    heard = []
    board.subscribe(lambda: heard.append(count(board)))
    total, few = count(board), int(left.contains(board.shown.model.gaussians.means).sum())
    board.keep(lambda run: run.keep(left))
    assert (count(board), board.shown.gaussian_count, board.shown.crop) == (few, few, left)
    board.keep(lambda run: run.keep(None))
    board.keep(type(board.shown).undo_keep)
    assert board.shown.crop == left
    board.keep(type(board.shown).undo_keep)
    assert heard == [few, total, few, total]


def test_marks_are_measured_in_what_is_kept(board, add, left):
    add()
    (whole,) = board.readings
    beside = Box.between(*left.low, left.high[0], left.low[1] + 0.3, left.high[2])
    board.keep(lambda run: run.keep(beside))
    board.refresh()
    assert board.readings[0].covered < 0.5 * whole.covered
    board.keep(type(board.shown).undo_keep)
    board.refresh()
    assert (board.readings[0].covered, board.readings[0].mean) == (whole.covered, whole.mean)


def test_what_another_program_keeps_is_followed_and_what_cannot_be_is_a_problem(board, left):
    survey = board._store.folder / SURVEY_FILE
    total = count(board)
    write_survey(survey, Survey(crop=(*left.low, *left.high)))
    board.refresh()
    assert (board.shown.crop, board.problems) == (left, ())
    write_survey(survey, Survey(crop=(90, 90, 90, 91, 91, 91)))
    board.refresh()
    assert "no Gaussian" in board.problems[0]
    assert board.shown.crop == left
    survey.unlink()
    board.refresh()
    assert (count(board), board.problems) == (total, ())


def test_a_run_that_was_given_cropped_can_be_shown_whole(small_run, balls, left):
    given = small_run.cropped(left)
    opened = subject_of(given, balls, small_run.folder.path).board
    assert count(opened) == given.gaussian_count
    opened.keep(lambda run: run.keep(None))
    assert count(opened) == small_run.gaussian_count


def test_of_a_model_in_training_nothing_is_left_out(board, disk):
    training = MarkBoard(disk, board._instruments)
    with pytest.raises(ConfigError, match="being trained"):
        training.keep(lambda run: run.keep(None))
