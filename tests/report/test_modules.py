"""The table of a plant's modules: what is found, what that is called, and what is written."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from mrgs.errors import ConfigError, RunError
from mrgs.maps.draw import BANDS, OrthographicMap
from mrgs.maps.surfaces import MapGrid
from mrgs.marks.measure import NARROW_HOT, NO_PHOTO
from mrgs.marks.photo_readings import CHANNELS, READING, RENDERED, SightingSums
from mrgs.marks.uncertainty import Budget
from mrgs.report.modules import (
    OF_READING,
    ModuleTable,
    _judged,
    _mean_over,
    _Seen,
    module_table,
)
from mrgs.report.overview import TemperatureMap
from mrgs.runs.open import Run
from mrgs.scene import WorldFrame
from mrgs.survey import Survey

MODULES, LONG, SHORT, STEP = 40, 33, 18, 0.05
NUMBERS = np.array([(1 + n // 20, 1, 1 + n % 20) for n in range(MODULES)])


def seen_plant() -> np.ndarray:
    """°C on two rows of modules, the second one 5 K colder; drift along both."""
    rng = np.random.default_rng(5)
    celsius = 45.0 - 5.0 * (NUMBERS[:, 0] - 1) + 0.1 * NUMBERS[:, 2] + rng.normal(0, 0.1, MODULES)
    return celsius[:, None, None] + rng.normal(0, 0.1, (MODULES, LONG, SHORT))


def judged(celsius, irradiance=800.0, power=400.0, pixel=0.05, kwh=1000.0):
    seen = _Seen(celsius, np.full(celsius.shape, 0.3), np.full(MODULES, 7.0), STEP)
    return list(_judged(seen, NUMBERS, Budget(), irradiance, power, kwh, pixel))


def test_sound_modules_have_no_findings():
    rows = judged(seen_plant())
    assert [row["finding"] for row in rows] == [""] * MODULES
    assert max(abs(row["delta_k"]) for row in rows) < 1.5
    assert {row["class"] for row in rows} == {1}
    assert {row["lost_w"] for row in rows} == {0.0}


@pytest.mark.parametrize(
    ("place", "kelvin", "finding", "severity", "lost"),
    [
        ((slice(None), slice(None)), 4.0, "hot module", 2, 1.0),
        ((slice(None), slice(0, 6)), 5.0, "hot third", 2, 1 / 3),
        ((slice(None), slice(6, 18)), 5.0, "two hot thirds", 2, 2 / 3),
        ((slice(10, 14), slice(8, 11)), 6.0, "hot cell", 1, 0.15),
        ((slice(10, 14), slice(8, 11)), 12.0, "hot cell", 2, 0.3),
        ((slice(10, 14), slice(8, 11)), 25.0, "hot cell", 3, 0.6),
    ],
)
def test_what_is_hot_has_a_name_a_class_and_a_loss(place, kelvin, finding, severity, lost):
    celsius = seen_plant()
    celsius[25][place] += kelvin
    row = judged(celsius)[25]
    assert (row["finding"], row["class"]) == (finding, severity)
    assert row["delta_k"] == pytest.approx(kelvin, abs=0.8)
    assert row["delta_1000_k"] == pytest.approx(row["delta_k"] * 1000 / 800)
    assert row["lost_w"] == pytest.approx(lost * 400 * 0.8)
    assert row["lost_kwh"] == pytest.approx(lost * 400)
    assert abs(row["delta_k"] - kelvin) < row["uncertainty_k"]


def test_a_cell_is_measured_over_whole_places_and_parts_of_them():
    values = np.random.default_rng(2).normal(0, 1, (2, 9, 8))
    for width in (1, 3):
        mean = ndimage.uniform_filter(values, (0, width, width), mode="nearest")
        np.testing.assert_allclose(_mean_over(values, width), mean, atol=1e-12)
    peak = np.zeros((1, 7, 7))
    peak[0, 3, 3] = 1.0
    assert _mean_over(peak, 0.6).max() == 1.0
    assert _mean_over(peak, 1.25).max() == pytest.approx(1 / 1.25**2)
    assert _mean_over(peak, 1.25).sum() == pytest.approx(1.0)


def test_a_place_that_the_model_has_not_resolved_is_uncertain_by_what_the_photos_read_beside_it():
    sums = SightingSums(2)
    for _ in range(5):
        values = np.zeros((2, CHANNELS), np.float32)
        values[:, RENDERED], values[:, READING] = 40.0, (40.0, 46.0)
        sums.add(np.arange(2), values, np.ones(2, np.float32))
    np.testing.assert_allclose(sums.readings, [40.0, 46.0])
    np.testing.assert_allclose(sums.parts(OF_READING, sums.rendered).total, [0.0, 6.0], atol=1e-6)


def test_several_cells_and_thirds_are_told_together():
    celsius = seen_plant()
    celsius[3, 4:7, 2:5] += 9.0
    celsius[3, 25:28, 13:16] += 8.0
    celsius[7, :, 12:] += 4.0
    celsius[7, 10:13, 2:5] += 15.0
    rows = judged(celsius)
    assert rows[3]["finding"] == "several hot cells"
    assert rows[7]["finding"] == "hot third, hot cell"
    assert rows[7]["lost_w"] == pytest.approx(400 * 0.8 / 3)


def test_a_place_narrower_than_three_pixels_is_remarked():
    celsius = seen_plant()
    celsius[3, 8:10, 8:10] += 20.0
    assert judged(celsius)[3]["remark"] == NARROW_HOT
    assert judged(celsius, pixel=0.02)[3]["remark"] == ""


@pytest.mark.parametrize("irradiance", [None, 500.0])
def test_without_sun_enough_nothing_is_normalised(irradiance):
    celsius = seen_plant()
    celsius[3, 8:12, 8:11] += 15.0
    row = judged(celsius, irradiance)[3]
    assert row["delta_1000_k"] is None
    assert row["class"] == 2
    assert (row["lost_w"] is None) == (irradiance is None)
    assert judged(celsius, 700.0, None)[3]["lost_w"] is None
    assert judged(celsius, 700.0, None)[3]["lost_kwh"] is None
    assert judged(celsius, kwh=None)[3]["lost_kwh"] is None
    assert judged(celsius, None)[3]["lost_kwh"] is None


def test_thirds_and_neighbours_that_no_photo_shows_do_not_count():
    celsius = seen_plant()
    celsius[25, :, :6] = np.nan
    celsius[25, :, 6:12] += 5.0
    row = judged(celsius)[25]
    assert row["class"] == 2
    assert row["delta_k"] == pytest.approx(5.0, abs=0.5)
    celsius = seen_plant()
    celsius[[n for n in range(len(celsius)) if n != 30]] = np.nan
    celsius[30, 8:12, 8:11] += 15.0
    row = judged(celsius)[30]
    assert (row["class"], row["delta_k"], row["finding"]) == (None, None, "")
    assert all(value == value for each in judged(celsius) for value in each.values())


def test_a_module_that_no_photo_shows_has_no_numbers():
    celsius = seen_plant()
    celsius[9] = np.nan
    rows = judged(celsius)
    assert (rows[9]["celsius"], rows[9]["delta_k"], rows[9]["remark"]) == (None, None, NO_PHOTO)
    assert rows[8]["delta_k"] is not None


@pytest.mark.parametrize(
    ("irradiance", "said"),
    [(None, "ist nicht angegeben"), (500.0, "unter 600"), (800.0, "0,19 kW")],
)
def test_the_page_says_what_the_sun_was(table, tmp_path, irradiance, said):
    rows = tuple(row if irradiance else row | {"lost_w": None} for row in table.rows)
    stated = replace(table, rows=rows, survey=Survey(irradiance_w_m2=irradiance))
    assert said in stated.write(tmp_path, "de")[0].read_text(encoding="utf-8")


@pytest.fixture
def table(opened: Run) -> ModuleTable:
    celsius = seen_plant()
    celsius[25, 8:12, 8:11] += 25.0
    celsius[9] = np.nan
    rows = judged(celsius)
    at = np.stack([NUMBERS[:, 2] * 1.05, -6.0 * NUMBERS[:, 0], np.zeros(MODULES)], axis=1)
    shape = np.array([(0, 0, 0), (1, 0, 0), (1, 1.7, 0.5), (0, 1.7, 0.5)])
    grid = MapGrid(np.eye(3), 1.0, np.zeros(2), 0.0, 0.0, 0.1, 240, 140, (-5.0, 5.0))
    shown = np.full((len(BANDS), 140, 240), 40.0, np.float32)
    drawn = OrthographicMap(grid, shown, np.zeros((140, 240, 3), np.float32))
    names = tuple(f"R{row}.{line}-{place}" for row, line, place in NUMBERS.tolist())
    scene = replace(opened.load_scene(), world=WorldFrame(metric=True, north=True))
    corners = at[:, None] + shape
    survey = Survey(irradiance_w_m2=800.0)
    size = (1.0, 1.77)
    picture = TemperatureMap(drawn, False, True)
    return ModuleTable(
        scene, picture, names, corners, tuple(rows), size, 0.05, survey, 400.0, 1000.0, ()
    )


def test_the_table_is_written_as_page_csv_geojson_and_map(table, tmp_path):
    page, table_file, geojson, picture = table.write(tmp_path, "de")
    text = page.read_text(encoding="utf-8")
    assert "40 Module von 1,00 × 1,77 m in 2 Reihen; 0 der Klasse 2, 1 der Klasse 3." in text
    assert "Im Jahr gehen etwa 0,24 MWh verloren" in text
    assert "R2.1-6" in text
    assert "heiße Zelle" in text
    assert "R2.1-7<" not in text
    rows = list(csv.DictReader(table_file.read_text(encoding="utf-8").splitlines()))
    assert len(rows) == MODULES
    assert (rows[25]["name"], rows[25]["class"], rows[25]["finding"]) == ("R2.1-6", "3", "hot cell")
    assert rows[9]["delta_k"] == ""
    features = json.loads(geojson.read_text(encoding="utf-8"))["features"]
    assert features[25]["geometry"]["type"] == "Polygon"
    assert features[25]["properties"]["class"] == 3
    assert picture.is_file()


def test_a_run_without_celsius_metres_or_a_view_from_above_is_refused(opened: Run) -> None:
    scene = opened.load_scene()
    cold = replace(opened, facts=opened.facts._replace(temperature=None))
    with pytest.raises(RunError, match="no temperatures in °C"):
        module_table(cold, (1.0, 1.7), scene=scene)
    unknown = replace(scene, world=WorldFrame())
    with pytest.raises(ConfigError, match="no scale"):
        module_table(opened, (1.0, 1.7), scene=unknown)
    level = replace(scene, world=WorldFrame(metric=True, north=True))
    with pytest.raises(RunError, match="photograph a plant from above"):
        module_table(opened, (1.0, 1.7), scene=level)


@pytest.mark.parametrize(
    ("size", "power", "kwh", "message"),
    [
        ((0.0, 1.7), None, None, "sides are"),
        ((1.0, float("nan")), None, None, "sides are"),
        ((1.0, 1.7), 0.0, None, "power"),
        ((1.0, 1.7), 400.0, 1.0, "100 to 3,000 kWh"),
        ((1.0, 1.7), None, 1000.0, "needs the power"),
    ],
)
def test_modules_that_cannot_be_are_refused(opened, size, power, kwh, message):
    with pytest.raises(ConfigError, match=message):
        module_table(opened, size, power, kwh)
