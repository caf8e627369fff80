from __future__ import annotations

import pytest

from mrgs.data.load import assign_splits
from mrgs.data.sources import FilenameLists, ReadingNotes


def split(keys, lists=FilenameLists()):  # noqa: B008
    notes = ReadingNotes()
    return "".join(side[0] for side in assign_splits(keys, lists, notes)), notes


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        (["images/frame_train_00001", "images/frame_eval_00002"], "te"),
        (["rgb/train/1", "rgb/test/1"], "te"),
        (["train/1", "val/1", "TEST/2"], "tee"),
        (["train/eval_1", "train/2"], "et"),  # the name before the folder
        (["a_train", "b_eval", "c"], "tet"),
        (["constrained_1", "evaluate_2"], "et"),  # no words of their own: every eighth
        (["train_1", "train_2", "train_3"], "ett"),  # one side only: perhaps a photo of a train
        (["only"], "t"),
    ],
)
def test_names(keys, expected):
    assert split(keys)[0] == expected


def test_every_eighth_of_the_sorted_names():
    keys = [f"{index:02d}" for index in reversed(range(17))]
    sides, notes = split(keys)
    assert [key for key, side in zip(keys, sides, strict=True) if side == "e"] == ["16", "08", "00"]
    assert "every 8th" in notes.all[0]


def test_lists():
    keys = ["a_eval", "b_train", "c", "d"]
    both = FilenameLists(frozenset({"a_eval", "c"}), frozenset({"b_train"}))
    assert split(keys, both)[0] == "tetu"
    assert split(keys, FilenameLists(None, frozenset({"c"})))[0] == "ttet"
    assert split(keys, FilenameLists(frozenset({"c"}), None))[0] == "uutu"


def test_conflicts_of_the_lists_are_mended():
    sides, notes = split(["a", "b"], FilenameLists(frozenset({"a", "b", "z"}), frozenset({"b"})))
    assert sides == "te"
    assert "held out" in notes.repaired[0]
    assert "such as z" in notes.repaired[1]
