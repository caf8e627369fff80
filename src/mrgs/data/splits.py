"""Split of the views: training and evaluation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Literal

from mrgs.data.sources import FilenameLists, ReadingNotes
from mrgs.system.message import Message

Split = Literal["train", "eval", "unused"]

EVAL_EVERY = 8
"""Every eighth view is held out where the files say nothing (Mip-NeRF 360's and 3DGS's
convention)."""

_WORD = re.compile(r"(?<![a-z])(train|eval|test|val)(?![a-z])")


def assign_splits(keys: Sequence[str], lists: FilenameLists, notes: ReadingNotes) -> list[Split]:
    """The split of each view.

    In this order: explicit lists of file names; the word train, eval, test or val in the file's
    name or else in its folder's (where both sides occur); every ``EVAL_EVERY``-th of the sorted
    keys.

    Args:
        keys: paths without extension, one per view.
        lists: explicit lists, as far as the files give them.
        notes: receives the rule that was used, and conflicts.
    """
    if lists.train is not None or lists.eval is not None:
        return _by_lists(keys, lists, notes)
    sides = [_side(key) for key in keys]
    if "train" in sides and "eval" in sides:
        return [side or "train" for side in sides]
    if len(keys) == 1:
        return ["train"]
    notes.decide(
        Message(
            "No split is given: every {number}th view, in the order of the names, is held out.",
            number=f"{EVAL_EVERY}",
        )
    )
    held_out = set(sorted(range(len(keys)), key=lambda index: keys[index])[::EVAL_EVERY])
    return ["eval" if index in held_out else "train" for index in range(len(keys))]


def _by_lists(keys: Sequence[str], lists: FilenameLists, notes: ReadingNotes) -> list[Split]:
    """A view in both lists is held out; without a training list, all others are for training."""
    held_out = lists.eval or frozenset()
    train = frozenset(keys) - held_out if lists.train is None else lists.train
    splits: list[Split] = [
        "eval" if key in held_out else "train" if key in train else "unused" for key in keys
    ]
    if train & held_out:
        notes.repair(
            f"{len(train & held_out)} images are listed for training and for evaluation; they are "
            f"held out."
        )
    if missing := (train | held_out) - frozenset(keys):
        notes.repair(
            f"{len(missing)} images of the split lists have no frame (such as {min(missing)}); "
            f"left out."
        )
    if unused := splits.count("unused"):
        notes.decide(f"{unused} frames are in none of the split lists; left out.")
    return splits


def _side(key: str) -> Literal["train", "eval"] | None:
    folder, _, name = key.lower().rpartition("/")
    for text in (name, folder.rpartition("/")[2]):
        if words := _WORD.findall(text):
            return "train" if words[0] == "train" else "eval"
    return None
