"""What a mark is: points on a surface, where they were drawn from, and the user's notes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, TypeAlias, get_args

from mrgs.errors import ConfigError
from mrgs.system.typed_json import from_json
from mrgs.system.wording import shown

MarkKind = Literal["spot", "line", "box", "polygon"]
KINDS: tuple[MarkKind, ...] = get_args(MarkKind)
AREAS: tuple[MarkKind, ...] = ("box", "polygon")
"""Kinds that enclose a part of a surface, and may have an emissivity."""

POINTS: Mapping[MarkKind, tuple[int, int]] = {
    "spot": (1, 1),
    "line": (2, 200),
    "box": (4, 4),
    "polygon": (3, 200),
}
"""Smallest and largest number of points of each kind."""

MOST_MARKS = 500
LONGEST_NAME = 40
LONGEST_SEVERITY = 40
LONGEST_NOTE = 2_000
FARTHEST = 1e9
"""Scene units."""

SAME_PLACE = 10.0
"""Distance between two spots, in radii of the earlier one, below which they are one place."""

EMISSIVITY = (0.01, 1.0)
REFLECTED_C = (-200.0, 3500.0)

_TEXTS = {
    "name": LONGEST_NAME,
    "note": LONGEST_NOTE,
    "severity": LONGEST_SEVERITY,
    "against": LONGEST_NAME,
}
"""Fields that are texts, and their greatest lengths."""

Place: TypeAlias = tuple[float, float, float]
"""World coordinates, scene units."""


@dataclass(frozen=True)
class Mark:
    """A place on a surface that is measured. ConfigError for a value that cannot be.

    Attributes:
        name: unique among the marks of a run.
        kind: a spot is a small disc, a line has a profile, boxes and polygons enclose an area.
        points: on the surface: the middle of the spot, the line's corners in order, or the corners
            of the outline.
        eye: where it was drawn from. It is measured as seen from there: what is behind something
            does not belong to it.
        radius: of a spot's disc, scene units; 0 for the other kinds.
        severity: of the finding: class 1 to 3 of IEC TS 62446-3, or free text.
        emissivity: of the surface in a box or polygon; None keeps that of the photos.
        reflected_c: reflected apparent temperature there, °C; None keeps that of the photos.
        against: name of the mark whose mean is subtracted in ΔT; empty for the reference.
    """

    name: str
    kind: MarkKind
    points: tuple[Place, ...]
    eye: Place
    radius: float = 0.0
    note: str = ""
    severity: str = ""
    emissivity: float | None = None
    reflected_c: float | None = None
    against: str = ""

    def __post_init__(self) -> None:
        if problem := self._problem():
            raise ConfigError(f"mark {shown(self.name)}: {problem}")

    @property
    def is_area(self) -> bool:
        """Whether it encloses a part of a surface."""
        return self.kind in AREAS

    @property
    def has_settings(self) -> bool:
        """Whether its surface has an emissivity or a reflected temperature of its own."""
        return self.emissivity is not None or self.reflected_c is not None

    @classmethod
    def from_json(cls, value: Any) -> Mark:
        """A mark from its JSON form; ConfigError if the value is not one."""
        try:
            mark = from_json(cls, value)
        except ValueError as error:
            raise ConfigError(f"{shown(value)} is not a mark: {error}") from None
        if unknown := value.keys() - {field.name for field in fields(cls)}:
            raise ConfigError(f"a mark has no field {shown(min(unknown))}")
        return mark

    def to_json(self) -> dict[str, Any]:
        """The mark as plain values; what is not set is left out."""
        return {
            name: value
            for name, value in asdict(self).items()
            if value not in (None, "") and (name != "radius" or self.kind == "spot")
        }

    def _problem(self) -> str:
        """Why it cannot be; empty if it can."""
        for field, longest in _TEXTS.items():
            text = getattr(self, field)
            if len(text) > longest or not all(c.isprintable() or c == "\n" for c in text):
                return f"its {field} must be a text of at most {longest:,} printable characters"
        if not self.name.strip():
            return "its name must not be empty"
        fewest, most = POINTS[self.kind]
        if not fewest <= len(self.points) <= most:
            wanted = f"{fewest}" if fewest == most else f"{fewest} to {most}"
            return f"a {self.kind} has {wanted} points, not {len(self.points)}"
        for place in (*self.points, self.eye):
            if not all(_is_number(each, -FARTHEST, FARTHEST) for each in place):
                return f"x, y and z must be finite numbers, not {shown(place)}"
        if self.kind == "spot" and not _is_number(self.radius, 1e-9, FARTHEST):
            return f"the radius of a spot must be above 0, not {shown(self.radius)}"
        if self.has_settings and not self.is_area:
            return "only boxes and polygons have an emissivity and a reflected temperature"
        limits = {"emissivity": (*EMISSIVITY, ""), "reflected_c": (*REFLECTED_C, " °C")}
        for field, (low, high, unit) in limits.items():
            value = getattr(self, field)
            if value is not None and not _is_number(value, low, high):
                return f"its {field} must be from {low:g} to {high:g}{unit}, not {shown(value)}"
        return ""


@dataclass(frozen=True)
class Marks:
    """All marks of a run, in the order in which they were made. ConfigError for two marks of the
    same name, a reference to no mark, or too many.

    Attributes:
        marks: that the user has drawn or accepted.
        reference: name of the mark that ΔT refers to; empty for none.
        proposals: hot and cold places that the report has found and nobody has judged yet.
        dropped: rejected proposals; nothing is proposed in their places again.

    All names differ.
    """

    marks: tuple[Mark, ...] = ()
    reference: str = ""
    proposals: tuple[Mark, ...] = ()
    dropped: tuple[Mark, ...] = ()

    def __post_init__(self) -> None:
        names = [mark.name for mark in (*self.marks, *self.proposals, *self.dropped)]
        if len(self.marks) > MOST_MARKS or len(names) > 2 * MOST_MARKS:
            raise ConfigError(f"more than {MOST_MARKS} marks: delete some")
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ConfigError(f"two marks are named {shown(twice[0])}: choose another name")
        for name in (self.reference, *(mark.against for mark in self.marks)):
            if name:
                self.named(name)  # raises where there is none

    def __len__(self) -> int:
        return len(self.marks)

    def named(self, name: str) -> Mark:
        """The mark of a name; ConfigError if there is none."""
        return _named(self.marks, name, "mark", "none")

    def free_names(self, letter: str, count: int) -> list[str]:
        """The first ``count`` names of a letter and a number from 1 that are not taken."""
        taken = {mark.name for mark in (*self.marks, *self.proposals, *self.dropped)}
        names = (f"{letter}{number}" for number in range(1, len(taken) + count + 1))
        return [name for name in names if name not in taken][:count]

    def adding(self, kind: MarkKind, name: str = "", **fields: Any) -> Marks:
        """These marks and a new one with the ``fields`` of ``Mark``. Without a name it is the first
        of S1, S2 ... that is not taken; L, B, P for the other kinds. ConfigError if the name is
        taken, or a value cannot be."""
        name = name or self.free_names(kind[0].upper(), 1)[0]
        return replace(self, marks=(*self.marks, Mark(name, kind, **fields)))

    def without(self, name: str) -> Marks:
        """These marks without one, which must exist; what referred to it refers to nothing."""
        self.named(name)
        kept = tuple(
            replace(mark, against="") if mark.against == name else mark
            for mark in self.marks
            if mark.name != name
        )
        reference = "" if self.reference == name else self.reference
        return replace(self, marks=kept, reference=reference)

    def changing(self, name: str, /, **changes: Any) -> Marks:
        """These marks with other fields of one; what refers to it follows a new name. ConfigError
        if there is no such mark, or a value cannot be."""
        changed = replace(self.named(name), **changes)
        marks = [changed if mark.name == name else mark for mark in self.marks]
        follow = {name: changed.name}
        return replace(
            self,
            marks=tuple(
                replace(each, against=follow.get(each.against, each.against)) for each in marks
            ),
            reference=follow.get(self.reference, self.reference),
        )

    def accepting(self, name: str, /, **changes: Any) -> Marks:
        """These marks and a proposal that becomes one, with other fields where they are given.
        ConfigError if there is no such proposal, or a value cannot be."""
        accepted = replace(self._proposed(name), **changes)
        return replace(self, marks=(*self.marks, accepted), proposals=self._proposals_without(name))

    def proposing(self, found: Mapping[str, Sequence[Mark]]) -> Marks:
        """These marks with other proposals, by the letters of their names: one near to a proposal
        from before keeps that name, the others have the next free ones."""
        proposals = []
        for letter, marks in found.items():
            free = iter(self.free_names(letter, len(marks)))
            left = [each for each in self.proposals if each.name.startswith(letter)]
            for mark in marks:
                away = [math.dist(each.points[0], mark.points[0]) for each in left]
                near = [p for p, d in zip(left, away, strict=True) if d < SAME_PLACE * p.radius][:1]
                name = near[0].name if near else next(free)
                left = [each for each in left if each not in near]
                proposals.append(replace(mark, name=name))
        return replace(self, proposals=tuple(proposals))

    def dropping(self, name: str) -> Marks:
        """These marks with a proposal, which must exist, dropped for good."""
        dropped = (*self.dropped, self._proposed(name))
        return replace(self, proposals=self._proposals_without(name), dropped=dropped)

    def _proposed(self, name: str) -> Mark:
        return _named(self.proposals, name, "proposal", "none; mrgs report finds them")

    def _proposals_without(self, name: str) -> tuple[Mark, ...]:
        return tuple(mark for mark in self.proposals if mark.name != name)


def _named(marks: Sequence[Mark], name: str, what: str, none: str) -> Mark:
    for mark in marks:
        if mark.name == name:
            return mark
    known = ", ".join(mark.name for mark in marks) or none
    raise ConfigError(f"there is no {what} {shown(name)}: the {what}s are {known}")


def places_of(points: Sequence[Sequence[float]]) -> tuple[Place, ...]:
    """Rows of an array [N, 3] as places."""
    return tuple((float(x), float(y), float(z)) for x, y, z in points)


def _is_number(value: Any, low: float, high: float) -> bool:
    """Whether JSON can express it, and it is between two limits."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
