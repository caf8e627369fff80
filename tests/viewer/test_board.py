"""The marks of a run for all who look at it, whoever changes its files."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import pytest

from mrgs.errors import ConfigError, RunError
from mrgs.marks import Mark, MarkReading
from mrgs.marks.measure import MarkMeter
from mrgs.marks.run_marks import box_corners, eye_of, picked_places
from mrgs.marks.store import MarkStore
from mrgs.survey import SURVEY_FILE
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.numbers import MarkNumbers


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
    surface = board.see(camera)

    def add_box(x: float = 80.0, y: float = 60.0) -> int:
        corners = box_corners((x - 4, y - 4), (x + 5, y + 5))
        board.add("box", picked_places(surface, corners), eye_of(camera), 0.0)
        return board.numbers[-1]

    return add_box


@pytest.fixture
def measured(monkeypatch) -> list[str]:
    """The marks that are measured from now on."""
    names: list[str] = []
    read = MarkMeter.read

    def noted(self: MarkMeter, mark: Mark, regions=None) -> MarkReading:
        names.append(mark.note or mark.kind)
        return read(self, mark, regions)

    monkeypatch.setattr(MarkMeter, "read", noted)
    return names


def test_a_mark_keeps_its_number_when_it_is_renamed_here_or_elsewhere(board, disk, add):
    first, second = add(), add(84.0)
    board.change(first, {"name": "Door"})
    disk.edit(lambda marks: marks.changing("Door", name="Gate"))
    board.change(first, {"note": "warm"})
    disk.edit(lambda marks: marks.without("B2"))
    board.refresh()
    assert board.numbers == [first]
    assert (board.marks.marks[0].name, board.marks.marks[0].note) == ("Gate", "warm")
    with pytest.raises(ConfigError, match="this mark has been deleted"):
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
    told: list[int] = []
    board.listen(lambda: told.append(len(board.marks)))
    assert not board.is_stale
    disk.edit(lambda marks: marks.without("B1"))
    assert board.is_stale
    board.refresh()
    board.refresh()
    assert told == [0]


def test_a_file_that_is_deleted_right_after_a_change_is_noticed(board, disk, add):
    board.refresh()
    add()
    disk.file.unlink()
    board.refresh()
    assert len(board.marks) == 0


def test_the_uncertainty_follows_the_survey(board, add):
    add()
    before = board.readings[0].uncertainty.total
    assert any("not known, and not included" in note for note in board.notes)
    (board._store.folder / SURVEY_FILE).write_text("camera_accuracy_c: 5")
    board.refresh()
    assert board.readings[0].uncertainty.total > before + 2
    assert not any("not known" in note for note in board.notes)


def test_files_that_cannot_be_read_leave_the_marks_and_say_why(board, disk, add):
    add()
    told: list[tuple[str, ...]] = []
    board.listen(lambda: told.append(board.problems))
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
    opened = MarkBoard(disk, board._meter, board.stereo, board._appraise)
    opened.refresh()
    assert "camera_accuracy_c" in opened.problems[0]
    survey.unlink()
    opened.refresh()
    assert (len(opened.readings), opened.problems) == (1, ())


def test_a_change_is_saved_though_it_cannot_be_measured(board, disk, add, monkeypatch):
    number = add()
    board.refresh()
    told: list[tuple[str, ...]] = []
    board.listen(lambda: told.append(board.problems))

    def fail(*_: object) -> None:
        raise RunError("the photo x.jpg cannot be read")

    with monkeypatch.context() as patched:
        patched.setattr(MarkMeter, "measure", fail)
        board.change(number, {"note": "saved"})
        board.refresh()
        (disk.folder / SURVEY_FILE).write_text("camera_accuracy_c: 5")
        board.refresh()
    assert set(told) == {("the photo x.jpg cannot be read",)}
    assert disk.read().marks[0].note == "saved"
    board.change(number, {"severity": "2"})
    board.refresh()
    assert (board.readings[0].mark.note, board.problems) == ("saved", ())
    assert not any("not known" in note for note in board.notes)


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


def test_a_run_that_is_gone_is_not_made_anew(board, disk, add, tmp_path):
    number = add()
    folder = board._store.folder
    away = folder.rename(folder.with_name("away"))
    for change in (lambda: board.change(number, {"note": "x"}), board.undo, add):
        with pytest.raises(RunError, match="is gone: nothing can be saved until it is back"):
            change()
    board.refresh()
    assert not folder.exists()
    assert len(board.marks) == 1
    assert "is gone" in board.problems[0]
    away.rename(folder)
    board.refresh()
    assert board.problems == ()
    board.change(number, {"note": "x"})


def test_only_what_a_change_can_affect_is_measured(board, disk, add, measured):
    number, other = add(), add(84.0)
    measured.clear()
    board.change(number, {"note": "a"})
    board.change(number, {"name": "Door", "severity": "2"})
    board.refer_to(other)
    disk.edit(lambda marks: marks.changing("B2", note="b"))
    board.refresh()
    assert measured == []
    assert board.readings[0].mark.note == "a"
    assert board.readings[0].difference == board.readings[0].mean - board.readings[1].mean
    add(76.0)
    assert measured == ["box"]
    board.change(number, {"emissivity": 0.6, "reflected_c": 0.0})
    assert len(measured) == 4


def test_what_is_missing_is_said_of_the_mark_by_its_name(board, add):
    number = add()
    board.change(number, {"emissivity": 0.6})
    assert "B1: the photos do not say the reflected temperature" in board.readings[0].problem
    board.change(number, {"name": "Door"})
    assert "Door: the photos do not say" in board.readings[0].problem
    board.change(number, {"reflected_c": 0.0})
    assert board.readings[0].problem == ""


def test_a_problem_has_the_name_that_the_mark_has_now(board, add, monkeypatch):
    def too_wide(self: MarkMeter, mark: Mark, regions=None) -> MarkReading:
        return replace(read(self, mark, regions), problem=f"{mark.name} is too wide")

    read = MarkMeter.read
    monkeypatch.setattr(MarkMeter, "read", too_wide)
    number = add()
    board.change(number, {"name": "Door"})
    assert board.readings[0].problem == "Door is too wide"
