from __future__ import annotations

from dataclasses import replace

import pytest

from mrgs.errors import ConfigError
from mrgs.marks import Mark, Marks

EYE = (0.0, -5.0, 0.0)
SPOT = Mark("S1", "spot", ((0.0, 0.0, 0.0),), EYE, radius=0.01)
SQUARE = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1.0), (0.0, 0.0, 1.0))
BOX = Mark("B1", "box", SQUARE, EYE, emissivity=0.6, reflected_c=-10.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": " "}, "empty"),
        ({"name": "x" * 41}, "its name .* 40"),
        ({"note": "\x1b[2J"}, "its note .* 2,000"),
        ({"points": ()}, "not 0"),
        ({"kind": "line"}, "2 to 200"),
        ({"radius": 0.0}, "radius"),
        ({"emissivity": 0.9}, "only boxes"),
    ],
)
def test_a_mark_that_cannot_be_is_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        replace(SPOT, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"emissivity": 0.0}, "emissivity .* 0.0$"),
        ({"emissivity": float("nan")}, "emissivity .* nan"),
        ({"reflected_c": -300.0}, "reflected_c .* -300"),
    ],
)
def test_settings_of_a_surface_have_limits(changes, message):
    with pytest.raises(ConfigError, match=message):
        replace(BOX, **changes)


@pytest.mark.parametrize("mark", [SPOT, BOX, replace(BOX, note="two\nlines", against="S1")])
def test_marks_survive_json(mark):
    assert Mark.from_json(mark.to_json()) == mark
    assert "radius" not in BOX.to_json()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (3, "is not a mark"),
        ({**SPOT.to_json(), "colour": "red"}, "'colour'"),
        ({**SPOT.to_json(), "points": "here"}, "points"),
        ({**SPOT.to_json(), "points": [[1, 2]]}, r"points\[0\]"),
        ({**SPOT.to_json(), "eye": [0, 0, 1e400]}, "finite"),
        ({**SPOT.to_json(), "eye": [0, 0, True]}, "eye"),
        ({**SPOT.to_json(), "name": 7}, "name: "),
        ({**BOX.to_json(), "emissivity": "high"}, "emissivity: "),
        ({**SPOT.to_json(), "kind": "circle"}, "circle"),
    ],
)
def test_json_that_is_no_mark_is_refused(value, message):
    with pytest.raises(ConfigError, match=message):
        Mark.from_json(value)


def test_names_are_unique_and_given_in_order():
    marks = Marks((SPOT, BOX))
    assert (marks.free_names("S", 1), marks.free_names("L", 2)) == (["S2"], ["L1", "L2"])
    with pytest.raises(ConfigError, match=r"two .* 'S1'"):
        marks.adding(**vars(replace(BOX, name="S1")))
    with pytest.raises(ConfigError, match=r"'S9': .* S1, B1"):
        Marks(marks.marks, "S9")
    with pytest.raises(ConfigError, match=r"'S9': .* none"):
        Marks().named("S9")


def test_what_refers_to_a_mark_follows_its_name_and_its_end():
    marks = Marks((SPOT, replace(BOX, against="S1")), reference="S1")
    renamed = marks.changing("S1", name="Outer wall")
    assert (renamed.reference, renamed.marks[1].against) == ("Outer wall", "Outer wall")
    gone = marks.without("S1")
    assert (gone.reference, gone.marks) == ("", (replace(BOX, against=""),))


def test_there_are_not_endlessly_many():
    many = tuple(replace(SPOT, name=f"S{number}") for number in range(501))
    with pytest.raises(ConfigError, match="500"):
        Marks(many)
