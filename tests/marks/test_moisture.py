from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from mrgs.marks.moisture import (
    dew_point_c,
    surface_at_factor_c,
    temperature_at_humidity_c,
    temperature_factor,
)

SCRIPT = Path(__file__).parents[2] / "src/mrgs/pictures/web/isotherm.js"
DEW_POINTS = [
    (20, 0.30, 1.9), (20, 0.40, 6.0), (20, 0.50, 9.3), (20, 0.60, 12.0), (20, 0.70, 14.4),
    (20, 0.80, 16.4), (20, 0.95, 19.1), (25, 0.50, 13.9), (25, 0.60, 16.7), (15, 0.50, 4.7),
    (10, 0.60, 2.6), (30, 0.80, 26.2),
]  # fmt: skip
"""From the table of dew points in DIN 4108-3, °C."""


@pytest.mark.parametrize(("air_c", "humidity", "expected"), DEW_POINTS)
def test_dew_points_are_those_of_the_standard(air_c, humidity, expected):
    assert dew_point_c(air_c, humidity) == pytest.approx(expected, abs=0.1)


def test_saturated_air_condenses_at_once():
    assert dew_point_c(17.3, 1.0) == pytest.approx(17.3)
    with pytest.raises(ValueError, match="a relative humidity is over 0 and at most 1"):
        dew_point_c(20.0, 0.0)


def test_mould_begins_where_the_standard_says():
    """DIN 4108-2: 20 °C, 50 %, -5 °C outside; 80 % at the surface are reached at 12.6 °C, 0.7."""
    limit = temperature_at_humidity_c(20.0, 0.5, 0.8)
    assert limit == pytest.approx(12.6, abs=0.05)
    assert temperature_factor(limit, 20.0, -5.0) == pytest.approx(0.70, abs=0.006)


def test_the_temperature_factor_and_back():
    assert temperature_factor(12.5, 20.0, -5.0) == pytest.approx(0.7)
    assert surface_at_factor_c(0.7, 20.0, -5.0) == pytest.approx(12.5)
    with pytest.raises(ValueError, match="needs a room that is warmer than outside"):
        temperature_factor(12.5, 10.0, 20.0)


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_the_pages_compute_the_same():
    calls = """
    const band = (mode, values) => isothermBand(mode, values);
    console.log(JSON.stringify([
      band("dew", [20, 50]), band("insulation", [20, -5, 0.7]), band("above", [30]),
      band("between", [30, 10]), band("dew", [20, null]), band("insulation", [5, 20, 0.7]),
      band("", []), band("below", [null]),
    ]));
    """
    source = SCRIPT.read_text(encoding="utf-8").partition("class IsothermControl")[0]
    run = subprocess.run(["node", "-e", source + calls], capture_output=True, text=True, check=True)
    dew, insulation, above, between, *none = json.loads(run.stdout)
    assert dew == [-1e6, pytest.approx(dew_point_c(20.0, 0.5))]
    assert insulation == [-1e6, pytest.approx(12.5)]
    assert above == [30, 1e6]
    assert between == [10, 30]
    assert none == [None] * 4
