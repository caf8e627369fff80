from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrgs.data.earth import enu
from mrgs.data.radiometric import GpsPosition
from mrgs.marks import Mark, Marks
from mrgs.marks.measure import NO_SURFACE, SEVERAL_SURFACES, MarkMeter, MarkReading
from mrgs.marks.tables import (
    difference_text,
    mark_text,
    settings_texts,
    size_text,
    text_rows,
    value_text,
    write_csv,
    write_geojson,
)
from mrgs.marks.uncertainty import Uncertainty
from mrgs.scene import EarthPosition, TemperatureRange, WorldFrame
from tests.helpers.walls import RANGE, render_wall

EYE = (1.0, -5.0, 0.5)
SPOT = Mark("S1", "spot", ((0.5, 0.0, 0.25),), EYE, radius=0.05, note="=HYPERLINK(1)\nleak, maybe")
LINE = Mark("L1", "line", ((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)), EYE)
SQUARE = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1.0), (0.0, 0.0, 1.0))
METRES = WorldFrame(metric=True)


@pytest.fixture(scope="module")
def readings() -> list[MarkReading]:
    marks = Marks((SPOT, LINE, Mark("B1", "box", SQUARE, EYE)), reference="L1")
    return MarkMeter(render_wall, RANGE).measure(marks)


def test_people_read_rounded_numbers_with_units(readings):
    rows = text_rows(readings, RANGE, METRES)
    assert rows[0][:8] == ("S1", "spot", "21.2", "–", "21.1", "21.4", "+1.2", "⌀ 0.100 m")
    assert rows[0][8:] == ("–", "–", "=HYPERLINK(1) leak, maybe")
    assert rows[1][6:8] == ("–", "2.00 m")
    assert rows[2][7] == "1.00 m²"
    assert size_text(readings[1], WorldFrame()) == "2.00 scene units"


def test_a_spot_in_an_area_says_what_it_is_corrected_for(tmp_path: Path):
    area = Mark("B1", "box", SQUARE, EYE, emissivity=0.5, reflected_c=-5.0)
    beside = replace(SPOT, name="S2", points=((-0.5, 0.0, 0.25),))
    over_the_edge = Mark("L1", "line", ((-1.0, 0.0, 0.5), (0.9, 0.0, 0.5)), EYE)
    marks = Marks((area, SPOT, beside, over_the_edge))
    readings = MarkMeter(render_wall, RANGE).measure(marks)
    for reading in readings[1:]:
        (row,) = text_rows([reading], RANGE, METRES)
        lines = mark_text(reading, "", RANGE, METRES)["lines"]
        for said in (settings_texts(reading), lines, row[-1:]):
            for value in ("ε 0.5", "−5.0 °C"):
                assert (value in " ".join(said)) == (reading.mark is SPOT), reading.mark.name
    table, _ = write_csv(tmp_path / "marks.csv", readings, RANGE, METRES)
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["emissivity"], row["reflected_c"]) for row in rows] == [
        ("0.5", "-5"), ("0.5", "-5"), ("", ""), ("", ""),
    ]  # fmt: skip
    assert [each.remarks for each in readings] == [(), (), (), (SEVERAL_SURFACES,)]


def test_lengths_and_areas_say_what_the_scale_leaves_open(readings, tmp_path: Path):
    world = WorldFrame(metric=True, scale_error=0.01)
    _, line, box = (row[7] for row in text_rows(readings, RANGE, world))
    assert line.endswith("± 0.04 m")
    assert box.endswith("± 0.04 m²")
    table, _ = write_csv(tmp_path / "marks.csv", readings, RANGE, world)
    with table.open(encoding="utf-8", newline="") as file:
        _, line, box = csv.DictReader(file)
    assert line["length_scale_uncertainty_m"] == box["area_scale_uncertainty_m2"] == "0.04"
    assert line["area_scale_uncertainty_m2"] == box["length_scale_uncertainty_m"] == ""


def test_values_as_text():
    celsius = TemperatureRange(-20.0, 40.0)
    assert value_text(-3.04, celsius, unit=True) == "−3.0 °C"
    assert value_text(-0.04, celsius, sign=True, unit=True) == "+0.0 K"
    assert value_text(0.25, None, unit=True) == "0.250"
    assert value_text(math.nan, celsius, unit=True) == "–"


def test_no_uncertainty_is_written_as_zero(readings):
    sure = replace(readings[0], uncertainty=Uncertainty(photos=0.003), difference=1.25)
    sure = replace(sure, difference_uncertainty=0.004)
    assert text_rows([sure], RANGE, METRES)[0][3] == "0.1"
    assert mark_text(sure, "", RANGE, METRES)["value"].endswith("± 0.1 °C")
    assert difference_text(sure, RANGE).endswith("± 0.1 K")


def test_a_narrow_range_has_more_decimals(readings):
    """20.0 to 20.4 °C: one decimal would tell five values apart."""
    narrow = TemperatureRange(20.0, 20.4)
    sure = replace(readings[0], mean=20.204, uncertainty=Uncertainty(photos=0.02))
    assert mark_text(sure, "", narrow, METRES)["value"].startswith("20.20 ± 0.02")


def test_the_profile_of_a_line_has_ends_with_units(readings):
    low, high, end = mark_text(readings[1], "", RANGE, METRES)["ends"]
    assert (low, high, end) == ("18.0 °C", "22.0 °C", "2.00 m")
    assert mark_text(readings[1], "", None, WorldFrame())["ends"][1:] == [
        "22.008", "2.00 scene units",
    ]  # fmt: skip
    unseen = replace(readings[1].profile, values=np.full_like(readings[1].profile.values, np.nan))
    for without in (readings[0], replace(readings[1], profile=unseen)):
        assert mark_text(without, "", RANGE, METRES)["ends"] == []


def test_a_mark_without_size_has_no_dash_for_it(readings):
    gone = MarkReading(readings[2].mark, problem="why")
    text = mark_text(gone, "", RANGE, METRES)
    assert (text["problem"], text["lines"]) == ("why", [])


def test_a_spreadsheet_reads_the_numbers_and_runs_nothing(readings, tmp_path: Path):
    table, profiles = write_csv(tmp_path / "marks.csv", readings, RANGE, METRES)
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["S1", "L1", "B1"]
    assert float(rows[0]["mean_c"]) == pytest.approx(21.25, abs=0.01)
    assert float(rows[0]["difference_c"]) == pytest.approx(1.25, abs=0.02)
    assert (rows[1]["length_m"], rows[1]["area_m2"], rows[2]["area_m2"]) == ("2", "", "1")
    assert rows[0]["note"] == "'=HYPERLINK(1)\nleak, maybe"
    assert profiles.name == "marks_profiles.csv"
    with profiles.open(encoding="utf-8", newline="") as file:
        samples = list(csv.DictReader(file))
    assert len(samples) == 200
    assert float(samples[-1]["distance"]) == pytest.approx(2.0)
    assert float(samples[-1]["value"]) == pytest.approx(22.0, abs=0.05)
    assert samples[-1]["uncertainty"] == ""  # no photos are known here


def test_without_celsius_and_metres_the_columns_say_so(readings, tmp_path: Path):
    (table,) = write_csv(tmp_path / "marks.csv", readings[:1], None, WorldFrame())
    heading = table.read_text(encoding="utf-8").splitlines()[0]
    assert "mean_normalised" in heading
    assert "length_units" in heading


def test_geojson_lies_on_earth_where_the_scene_does(readings, tmp_path: Path):
    origin = EarthPosition(48.1, 11.5, 520.0)
    world = WorldFrame(True, True, origin)
    document = json.loads(
        write_geojson(tmp_path / "m.geojson", readings, RANGE, world).read_text(encoding="utf-8")
    )
    spot, line, box = document["features"]
    assert "coordinates" not in document
    longitude, latitude, height = spot["geometry"]["coordinates"]
    back = enu([GpsPosition(latitude, longitude, height)], GpsPosition(*origin))[0]
    assert back == pytest.approx(SPOT.points[0], abs=2e-4)
    assert line["geometry"]["type"] == "LineString"
    ring = np.array(box["geometry"]["coordinates"][0])
    assert len(ring) == 5
    assert (ring[0] == ring[-1]).all()
    assert box["properties"]["area_m2"] == pytest.approx(1.0)
    assert spot["properties"]["length_m"] is None


def test_geojson_elsewhere_has_the_scenes_own_coordinates(readings, tmp_path: Path):
    path = write_geojson(tmp_path / "m.geojson", readings, RANGE, METRES)
    document = json.loads(path.read_text(encoding="utf-8"))
    assert "not on Earth" in document["coordinates"]
    assert document["features"][0]["geometry"]["coordinates"] == list(SPOT.points[0])


def test_what_has_no_temperature_says_why(tmp_path: Path):
    gone = replace(SPOT, points=((9.0, 0.0, 0.0),), note="")
    readings = MarkMeter(render_wall, RANGE).measure(Marks((gone,)))
    (row,) = text_rows(readings, RANGE, METRES)
    assert row[2:6] == ("–", "–", "–", "–")
    assert row[-1] == NO_SURFACE
    (table,) = write_csv(tmp_path / "marks.csv", readings, RANGE, METRES)
    assert "nan" not in table.read_text(encoding="utf-8")
