from __future__ import annotations

from pathlib import Path

import pytest

from mrgs.errors import ConfigError
from mrgs.prepare import KnownDistance, PrepareOptions, parse_known_distance, parse_target
from mrgs.prepare.rig.contract import ChessboardTarget


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"thermal_fov_deg": 0.5},
            "0.5°.*1° and 150°",
        ),
        ({"thermal_fov_deg": float("nan")}, "nan°"),
        ({"eval_every": 1}, "held out.*2 or more"),
        ({"eval_every": -3}, "held out.*2 or more"),
    ],
)
def test_what_cannot_be_is_told(options, message):
    with pytest.raises(ConfigError, match=message):
        PrepareOptions(**options)


@pytest.mark.parametrize(
    ("camera", "name"),
    [
        ("45°", "a-45"),
        ("(16 x 12)", "a-16-x-12"),
        (59 * "x" + " y", f"a-{59 * 'x'}"),
        ("°", "a"),
        (None, "a"),
    ],
)
def test_folders_have_the_names_of_cameras_without_punctuation_at_their_ends(camera, name):
    assert PrepareOptions(camera=camera).name_of(Path("a")) == name


@pytest.mark.parametrize(
    "other",
    [
        {"target": ChessboardTarget((7, 6))},
        {"thermal_camera": Path("x")},
        {"thermal_fov_deg": 50.0},
    ],
)
def test_one_camera_excludes_what_is_known_of_a_second(other):
    with pytest.raises(ConfigError, match="second camera") as error:
        PrepareOptions(one_camera=True, **other)
    assert error.value.options == ("one_camera", *other)


def test_distances_are_written_as_the_page_shows_them():
    known = KnownDistance("IR_0001", (120.0, 85.5), (310.0, -4.0), 1.2)
    assert parse_known_distance("IR_0001:120,85.5", "IR_0001:310,-4", 1.2) == known


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        (
            "IR_0001",
            "IR_0001:1,2",
            "'IR_0001': .*NAME:X,Y",
        ),
        ("IR_0001:1,2", "IR_0001:1;2", "'IR_0001:1;2': .*NAME:X,Y"),
        ("a:1,2", "b:1,2", "one view"),
    ],
)
def test_distances_that_say_nothing_are_told(first, second, message):
    with pytest.raises(ConfigError, match=message):
        parse_known_distance(first, second, 1.0)


def test_targets_are_counted_in_inner_corners():
    target = parse_target("7x6", 0.05)
    assert (target.inner, target.square_m) == ((7, 6), 0.05)
    for text in ("7", "7-6", "ax6", "7x6x5"):
        with pytest.raises(ConfigError, match=rf"'{text}': .*inner corners"):
            parse_target(text, 0.05)
