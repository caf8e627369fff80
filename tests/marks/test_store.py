from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrgs.errors import ConfigError, MrgsWarning, RunError
from mrgs.marks import Mark, Marks
from mrgs.marks.store import CameraSpread, MarkStore

SPREAD = CameraSpread(40, (0.0, 0.0, 1.0), 2.0)
SPOT = Mark("S1", "spot", ((0.0, 0.0, 0.0),), (0.0, -5.0, 0.0), radius=0.01, note="über der Tür")


@pytest.fixture
def store(tmp_path: Path) -> MarkStore:
    return MarkStore(tmp_path, SPREAD)


def add(store: MarkStore, name: str) -> Marks:
    return store.edit(lambda marks: marks.adding(**vars(replace(SPOT, name=name))))


def test_what_is_saved_is_read_again(store):
    assert store.read() == Marks()
    assert store.stamp is None
    saved = add(store, "S1")
    assert MarkStore(store.folder, SPREAD).read() == saved == Marks((SPOT,))
    text = store.file.read_text(encoding="utf-8")
    assert "über der Tür" in text
    assert json.loads(text)["version"] == 2
    assert store.stamp is not None


def test_proposals_and_what_was_dropped_are_kept_and_undone(store):
    add(store, "S1")
    found = tuple(replace(SPOT, name=name) for name in ("H1", "H2"))
    store.edit(lambda marks: replace(marks, proposals=found))
    store.edit(lambda marks: marks.accepting("H1", severity="2", note="leak"))
    judged = store.edit(lambda marks: marks.dropping("H2"))
    assert [mark.name for mark in judged.marks] == ["S1", "H1"]
    assert judged.named("H1") == replace(found[0], severity="2", note="leak")
    assert (judged.proposals, judged.dropped) == ((), found[1:])
    assert MarkStore(store.folder, SPREAD).read() == judged
    assert store.undo().proposals == found[1:]
    assert store.undo().proposals == found


def test_files_without_proposals_are_read(store):
    add(store, "S1")
    document = json.loads(store.file.read_text(encoding="utf-8"))
    old = {name: document[name] for name in ("program", "cameras", "reference", "marks")}
    store.file.write_text(json.dumps({**old, "version": 1}), encoding="utf-8")
    assert store.read() == Marks((SPOT,))


def test_every_change_is_undone_in_turn_by_any_process(store):
    states = [add(store, name) for name in ("S1", "S2", "S3")]
    store.edit(lambda marks: marks)  # changes nothing, so it is no step
    other = MarkStore(store.folder, SPREAD)
    assert [other.undo(), store.undo(), other.undo()] == [states[1], states[0], Marks()]
    with pytest.raises(ConfigError, match="nothing to undo"):
        store.undo()


def test_a_change_that_fails_changes_nothing(store):
    add(store, "S1")
    before = store.file.read_bytes()
    with pytest.raises(ConfigError, match=r"two .* 'S1'"):
        add(store, "S1")
    assert store.file.read_bytes() == before
    assert store.undo() == Marks()


def test_a_change_that_was_cut_off_is_no_step_of_its_own(store):
    """The earlier state is written first, so a crash leaves it twice."""
    add(store, "S1")
    before = store.file.read_bytes()
    add(store, "S2")
    store.file.write_bytes(before)
    assert store.undo() == Marks()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"{", "not JSON"),
        (b"\xff\xfe\x00", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[1]", "object"),
        (b'{"version": 1}', "cameras"),
        (b'{"version": 1, "cameras": {"images": 40, "centre": [1], "extent": 2}}', "cameras"),
        (b'{"version": 1, "cameras": {"images": 1e999, "centre": [], "extent": 2}}', "cameras"),
    ],
)
def test_a_damaged_file_is_kept_under_another_name(store, content, reason):
    saved = add(store, "S1")
    store.file.write_bytes(content)
    with pytest.warns(MrgsWarning, match=reason) as caught:
        assert store.read() == Marks()
    (message,) = {str(each.message) for each in caught}
    assert "\n" not in message
    assert "marks.json is damaged" in message
    assert " marks.json.damaged;" in message
    assert (store.folder / "marks.json.damaged").read_bytes() == content
    assert not store.file.exists()
    add(store, "S2")
    store.file.write_bytes(content)
    with pytest.warns(MrgsWarning, match=r"kept as marks\.json\.damaged2;"):
        store.read()
    assert saved.marks[0].name == "S1"


def test_the_marks_before_the_damage_come_back_by_undo(store):
    states = [add(store, name) for name in ("S1", "S2")]
    store.file.write_text("")
    with pytest.warns(MrgsWarning, match="undo"):
        assert store.undo() == states[0]


def test_a_damaged_mark_is_named(store):
    add(store, "S1")
    document = json.loads(store.file.read_text())
    document["marks"][0]["radius"] = "wide"
    store.file.write_text(json.dumps(document))
    with pytest.warns(MrgsWarning, match="radius"):
        store.read()


def test_a_damaged_undo_file_costs_only_the_undoing(store):
    saved = add(store, "S1")
    (store.folder / "marks.undo.json").write_text("{}")
    assert store.read() == saved
    with (
        pytest.warns(MrgsWarning, match=r"marks\.undo\.json is damaged"),
        pytest.raises(ConfigError, match="nothing to undo"),
    ):
        store.undo()
    assert store.read() == saved


def test_marks_of_another_model_are_refused_and_kept(store):
    add(store, "S1")
    before = store.file.read_bytes()
    other = MarkStore(store.folder, replace(SPREAD, centre=(0.0, 0.5, 1.0)))
    for action in (other.read, other.undo, lambda: add(other, "S2")):
        with pytest.raises(RunError, match="another model"):
            action()
    assert store.file.read_bytes() == before


def test_another_machine_rounds_differently(store):
    saved = add(store, "S1")
    near = replace(SPREAD, extent=SPREAD.extent * (1 + 1e-5))
    assert MarkStore(store.folder, near).read() == saved


def test_a_newer_file_is_left_alone(store):
    add(store, "S1")
    document = json.loads(store.file.read_text())
    store.file.write_text(json.dumps({**document, "version": 3}))
    with pytest.raises(RunError, match="newer version"):
        store.read()
    assert store.file.exists()


def test_the_spread_of_cameras():
    spread = CameraSpread.of(np.array([[0.0, 0, 0], [4, 0, 0]]))
    assert spread == CameraSpread(2, (2.0, 0.0, 0.0), 2.0)
