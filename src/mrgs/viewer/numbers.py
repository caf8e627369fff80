"""Numbers by which a page knows marks, whatever they are named."""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Sequence

from mrgs.marks.mark import Mark


class MarkNumbers:
    """Gives each mark a number that stays its own when it is renamed, also by another program."""

    def __init__(self) -> None:
        self._known: dict[int, Mark] = {}
        self._unused = itertools.count(1)

    def of(self, marks: Sequence[Mark]) -> list[int]:
        """The number of each mark: that of the mark that had its name and lay at its place, else of
        one that lay there, else a new one."""
        found: dict[int, int] = {}
        for key in (_name_and_place, _place):
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


def _place(mark: Mark) -> Hashable:
    return mark.kind, mark.points, mark.eye


def _name_and_place(mark: Mark) -> Hashable:
    return mark.name, _place(mark)
