from __future__ import annotations

import dataclasses
import json

import pytest

from mrgs.scene import (
    RGB,
    THERMAL,
    Modality,
    in_order,
    known_modalities,
    modality_named,
    register_modality,
)
from tests.helpers.gaussians import NEAR_INFRARED


def test_rgb_and_thermal_are_known():
    assert known_modalities() == (RGB, THERMAL)
    assert (RGB.channels, RGB.unit, RGB.title) == (3, None, "RGB")
    assert (THERMAL.channels, THERMAL.unit, THERMAL.title) == (1, "°C", "thermal")
    assert f"{RGB}, {THERMAL}" == "rgb, thermal"


def test_a_modality_is_a_value():
    assert Modality("nir", 1, title="near infrared") == NEAR_INFRARED
    assert {NEAR_INFRARED: 1}[Modality("nir", 1, title="near infrared")] == 1
    assert Modality("nir", 1) == NEAR_INFRARED  # unit and title only say how it is shown
    assert Modality("nir", 1) != Modality("nir", 2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        NEAR_INFRARED.channels = 2


def test_modalities_are_sorted_by_name():
    assert sorted([THERMAL, NEAR_INFRARED, RGB]) == [NEAR_INFRARED, RGB, THERMAL]


@pytest.mark.parametrize("name", ["a", "nir", "nir_2", "short_wave_infrared"])
def test_names_are_lower_case_identifiers(name):
    assert str(Modality(name, 1)) == Modality(name, 1).title == name


@pytest.mark.parametrize("name", ["", "NIR", "near infrared", "2nd", "_nir", "nir_", "a.b", "a\n"])
def test_other_names_are_refused(name):
    with pytest.raises(ValueError, match="lower-case"):
        Modality(name, 1)


@pytest.mark.parametrize("channels", [0, -1])
def test_a_modality_needs_a_channel(channels):
    with pytest.raises(ValueError, match=r"nir .*channel"):
        Modality("nir", channels)


@pytest.mark.parametrize("texts", [{"unit": "W\n"}, {"title": "n" * 41}, {"title": "a\x1bb"}])
def test_texts_that_cannot_be_shown_are_refused(texts):
    with pytest.raises(ValueError, match=r"nir .*printable"):
        Modality("nir", 1, **texts)


def test_modalities_come_back_from_json():
    for modality in (RGB, THERMAL, NEAR_INFRARED):
        found = Modality.from_json(json.loads(json.dumps(modality.to_json())))
        assert dataclasses.astuple(found) == dataclasses.astuple(modality)
    assert Modality.from_json({"name": "nir", "channels": 1}) == NEAR_INFRARED


@pytest.mark.parametrize(
    "value",
    [
        None,
        ["nir", 1],
        {"name": "nir"},
        {"channels": 1},
        {"name": 3, "channels": 1},
        {"name": "nir", "channels": True},
        {"name": "nir", "channels": 1.5},
        {"name": "nir", "channels": 0},
        {"name": "NIR", "channels": 1},
        {"name": "nir", "channels": 1, "unit": 3},
        {"name": "nir", "channels": 1, "title": None},
    ],
)
def test_what_is_no_modality_is_refused(value):
    with pytest.raises(ValueError, match="modality"):
        Modality.from_json(value)


def test_modalities_have_one_order():
    ultraviolet = Modality("uv", 1)
    found = in_order([ultraviolet, THERMAL, NEAR_INFRARED, RGB, THERMAL])
    assert found == (RGB, THERMAL, NEAR_INFRARED, ultraviolet)
    assert in_order([]) == ()


def test_a_registered_modality_is_known_by_its_name(near_infrared):
    assert known_modalities() == (RGB, THERMAL, near_infrared)
    assert modality_named("nir") is near_infrared
    assert register_modality(Modality("nir", 1, title="near infrared")) == near_infrared
    assert len(known_modalities()) == 3


@pytest.mark.parametrize("other", [Modality("nir", 3), Modality("rgb", 1), Modality("thermal", 2)])
def test_a_name_stands_for_one_modality(other, near_infrared):
    with pytest.raises(ValueError, match=f"another modality '{other}'"):
        register_modality(other)
    assert known_modalities() == (RGB, THERMAL, near_infrared)


def test_an_unknown_name_is_named_with_those_that_are_known():
    with pytest.raises(ValueError, match=r"'nir'; .*rgb, thermal"):
        modality_named("nir")
