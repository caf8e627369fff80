"""Parts of the report that need no model."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mrgs import load_scene
from mrgs.marks import Mark
from mrgs.marks.measure import MarkReading, Profile
from mrgs.report.findings import CHART_HEIGHT, CHART_LEFT, CHART_WIDTH, _chart, _factor, _part_about
from mrgs.report.sections import capture_rows, thermal_pixel_m
from mrgs.report.texts import LANGUAGES, Language, Texts
from mrgs.scene import THERMAL, Camera, EarthPosition, TemperatureRange, WorldFrame
from mrgs.scene.radiometry import ObjectParameters, PhotoRecord
from mrgs.survey import Survey


def test_colours_span_what_lies_about_a_mark():
    """Not the sky above, nor the ground below it."""
    camera = Camera.from_fov(200, 100, 90).look_at([0.0, -4.0, 0.0], [0.0, 0.0, 0.0])
    spot = Mark("S1", "spot", ((0.0, 0.0, 0.0),), (0.0, -4.0, 0.0), radius=0.1)
    assert _part_about(spot, camera) == (slice(20, 80), slice(40, 160))
    corner = replace(spot, points=((3.62, 0.0, 0.0),))
    assert _part_about(corner, camera)[1].start == 130


@pytest.mark.parametrize(
    ("world", "text"),
    [
        (WorldFrame(), "without a scale"),
        (WorldFrame(metric=True), "in metres"),
        (WorldFrame(True, True, EarthPosition(48.0, 11.0, None), 0.64), "0,64 m neben"),
        (WorldFrame(True, True, EarthPosition(48.0, 11.0, None), 0.0031), "0,0031 m neben"),
        (WorldFrame(True, True, control_m=0.0123), "Längen weichen um 0,012 m ab"),
    ],
)
def test_the_report_says_where_lengths_come_from(small_scene: Path, world: WorldFrame, text: str):
    scene = replace(load_scene(small_scene), world=world)
    language = "de" if "0," in text else "en"
    rows = dict(capture_rows(scene, Survey(), Texts(language)))
    assert text in rows[Texts(language)("Lengths")]


@pytest.mark.parametrize(
    ("mean", "factor"), [(-10.0, "0.00"), (5.0, "0.50"), (20.0, "1.00"), (21.0, "–"), (-11.0, "–")]
)
def test_a_place_that_is_warmer_than_the_room_has_no_temperature_factor(mean: float, factor: str):
    survey = Survey(side="inside", inside_c=20.0, outside_c=-10.0)
    assert _factor(mean, math.nan, survey) == factor


@pytest.mark.parametrize("air", [None, 1.5])
def test_the_uncertainty_of_a_temperature_factor_is_that_of_a_monte_carlo(air: float | None):
    rng = np.random.default_rng(0)
    kelvin = 0.5 if air is None else air
    surface, inside, outside = (
        at + sigma * rng.normal(size=200_000)
        for at, sigma in ((12.0, 0.9), (20.0, kelvin), (-5.0, kelvin))
    )
    around = np.diff(np.percentile((surface - outside) / (inside - outside), [2.5, 97.5]))[0] / 2
    survey = Survey(side="inside", inside_c=20.0, outside_c=-5.0, air_uncertainty_c=air)
    assert _factor(12.0, 1.8, survey) == f"0.68 ± {around:.2f}"


@pytest.mark.parametrize(
    ("mean", "survey"),
    [
        (5.0, Survey(side="outside", inside_c=20.0, outside_c=-10.0)),
        (5.0, Survey(inside_c=20.0, outside_c=-10.0)),
        (25.0, Survey(side="inside", inside_c=20.0, outside_c=33.0)),
        (20.0, Survey(side="inside", inside_c=20.0, outside_c=20.0)),
        (5.0, Survey(side="inside", inside_c=20.0)),
    ],
)
def test_only_surfaces_inside_a_heated_room_have_a_temperature_factor(mean: float, survey: Survey):
    assert _factor(mean, 0.3, survey) == "–"


def test_a_profile_is_interrupted_where_there_is_no_surface():
    line = Mark("L1", "line", ((0.0, 0.0, 0.0), (4.0, 0.0, 0.0)), (2.0, -4.0, 0.0))
    values = np.array([10.0, 20.0, np.nan, 15.0, 12.5])
    profile = Profile(np.arange(5.0), values, np.full(5, np.nan))
    reading = MarkReading(line, 14.0, 10.0, 20.0, length=4.0, profile=profile)
    scene = SimpleNamespace(temperature=TemperatureRange(0.0, 30.0), world=WorldFrame(metric=True))
    chart = _chart(reading, scene)
    assert (chart.low, chart.high, chart.end) == ("10.0 °C", "20.0 °C", "4.00 m")
    parts = re.findall(r"([ML])([\d.]+) ([\d.]+)", chart.path)
    assert [letter for letter, _, _ in parts] == ["M", "L", "M", "L"]
    left, wide = CHART_LEFT, CHART_WIDTH - CHART_LEFT - 4
    top, high = 10, CHART_HEIGHT - 34
    expected = [(0, 1), (1 / 4, 0), (3 / 4, 1 / 2), (1, 3 / 4)]
    for (_, x, y), (along, down) in zip(parts, expected, strict=True):
        assert float(x) == pytest.approx(left + along * wide, abs=0.06)
        assert float(y) == pytest.approx(top + down * high, abs=0.06)


def test_cameras_are_said_to_be_shared_only_where_all_views_share_theirs(small_scene: Path):
    scene = load_scene(small_scene)
    view = scene.train[0]
    camera = view.images[THERMAL].camera
    apart = replace(view.images[THERMAL], camera=camera.resized(20, 16))
    mixed = replace(
        scene,
        train=(replace(view, images=view.images | {THERMAL: apart}), *scene.train[1:]),
    )
    said = [dict(capture_rows(each, Survey(), Texts())) for each in (scene, mixed)]
    assert [rows["Cameras"].split()[0] for rows in said] == ["one", "each"]
    photos = said[1]["Thermal photos"]
    assert photos.startswith("8,")
    assert re.findall(r"\d+ × \d+", photos) == ["20 × 16", "40 × 30"]


def test_thermal_photos_alone_have_no_two_cameras(make_scene):
    rows = dict(capture_rows(load_scene(make_scene(rgb=False)), Survey(), Texts()))
    assert "Cameras" not in rows
    assert rows["RGB photos"] == "none"


def test_a_hot_range_is_written_without_an_exponent(small_scene: Path):
    scene = replace(load_scene(small_scene), temperature=TemperatureRange(-20.0, 1650.0))
    rows = dict(capture_rows(scene, Survey(), Texts("de")))
    assert re.findall(r"[−\d,]+", rows["Temperaturbereich"]) == ["−20,0", "1650,0"]


def test_the_pixel_of_the_thermal_photos_is_that_on_what_they_show(small_scene: Path):
    scene = load_scene(small_scene)
    assert thermal_pixel_m(replace(scene, world=WorldFrame())) is None
    camera = scene.train_photos(THERMAL)[0].camera
    distance = (scene.points.positions.double() - camera.position).norm(dim=1).median().item()
    found = thermal_pixel_m(replace(scene, world=WorldFrame(metric=True)))
    assert found == pytest.approx(distance / camera.K[0, 0].item(), rel=0.3)


@pytest.mark.parametrize("language", LANGUAGES)
def test_the_settings_of_a_window_are_reported_where_there_is_one(
    small_scene: Path, language: Language
):
    scene, t = load_scene(small_scene), Texts(language)
    view = scene.train[0]
    for transmission in (1.0, 0.9):
        parameters = ObjectParameters(0.95, 3.0, 15.0, 20.0, 0.5, 22.0, transmission)
        noted = replace(view.images[THERMAL], record=PhotoRecord(parameters=parameters))
        noted_view = replace(view, images=view.images | {THERMAL: noted})
        rows = dict(capture_rows(replace(scene, train=(noted_view,)), Survey(), t))
        text = rows[t("Settings of the temperatures")]
        for of_the_air in ("20.0 °C", "0.50"):
            assert t.number(of_the_air) in text
        assert (t.number("22.0 °C") in text) == (transmission < 1)
    assert text.endswith(t.number("0.90"))
