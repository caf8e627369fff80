from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[2] / "src/mrgs/pictures/web/isotherm.js"
DEW_POINTS = [
    (20, 30, 1.9), (20, 40, 6.0), (20, 50, 9.3), (20, 60, 12.0), (20, 70, 14.4), (20, 80, 16.4),
    (20, 95, 19.1), (25, 50, 13.9), (25, 60, 16.7), (15, 50, 4.7), (10, 60, 2.6), (30, 80, 26.2),
    (17.3, 100, 17.3),
]  # fmt: skip
"""°C of the air, relative humidity in per cent and dew point in °C, from the table of DIN 4108-3;
saturated air condenses at once."""

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="no node")


def bands(*calls: tuple[str, list[float | None]]) -> list[Any]:
    source = SCRIPT.read_text(encoding="utf-8").partition("class IsothermControl")[0]
    script = f"{source}\nconst calls = {json.dumps(calls)};\n"
    script += "console.log(JSON.stringify(calls.map((call) => isothermBand(...call))));"
    run = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True)
    found: list[Any] = json.loads(run.stdout)
    return found


def test_dew_points_are_those_of_the_standard():
    found = bands(*(("dew", [air, humidity]) for air, humidity, _ in DEW_POINTS))
    expected = [pytest.approx([-1e6, dew], abs=0.1) for _, _, dew in DEW_POINTS]
    assert found == expected


def test_insulation_follows_the_temperature_factor():
    """DIN 4108-2: 12.5 °C at 20 °C inside, -5 °C outside and a factor of 0.7."""
    warm, cold = bands(("insulation", [20, -5, 0.7]), ("insulation", [5, 20, 0.7]))
    assert warm == pytest.approx([-1e6, 12.5])
    assert cold is None


def test_bands_are_open_at_one_end_or_between_two_numbers():
    assert bands(("above", [30]), ("below", [30])) == [[30, 1e6], [-1e6, 30]]
    assert bands(("between", [30, 10])) == [[10, 30]]


def test_there_is_no_band_without_its_numbers():
    assert bands(("dew", [20, None]), ("", []), ("below", [None])) == [None] * 3
