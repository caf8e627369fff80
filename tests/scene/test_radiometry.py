from __future__ import annotations

import json
from datetime import datetime

import pytest

from mrgs.scene.radiometry import ObjectParameters, PhotoRecord, Planck

RECORD = PhotoRecord(
    "FLIR radiometric JPEG",
    "FLIR E60",
    "49000001",
    datetime(2026, 1, 17, 6, 30, 5, 250_000),
    ObjectParameters(0.95, 2.0, 20.0, 18.0, 0.4),
    Planck(15000.0, 0.0125, 1400.0, 1.0, -6000.0),
)


@pytest.mark.parametrize(
    "record",
    [RECORD, PhotoRecord(), PhotoRecord(serial="7"), PhotoRecord(given={"emissivity": 0.7})],
)
def test_a_record_survives_json(record):
    assert PhotoRecord.from_json(json.loads(json.dumps(record.to_json()))) == record
    assert PhotoRecord().to_json() == {}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (3, "object"),
        ({"serial": 7}, "serial"),
        ({"camera": "\x1b[2J"}, "camera"),
        ({"taken": 5}, "taken"),
        ({"taken": "yesterday"}, "taken"),
        ({"planck": [1, 2]}, "planck"),
        ({"planck": {"r1": 1.0}}, "planck.*r2"),
        ({"parameters": {"emissivity": "high"}}, r"parameters\.emissivity"),
        ({"given": {"colour": 1}}, "colour"),
        ({"given": {"emissivity": 2}}, "given.*emissivity"),
        ({**RECORD.to_json(), "planck": {"r1": 0, "r2": 1, "b": 1, "f": 1, "o": 1}}, "R1 = 0"),
    ],
)
def test_what_is_no_record_is_refused(value, message):
    with pytest.raises(ValueError, match=message):
        PhotoRecord.from_json(value)


def test_a_wrong_emissivity_is_refused():
    value = RECORD.to_json()
    value["parameters"]["emissivity"] = 2.0
    with pytest.raises(ValueError, match=r"2 .*between 0\.01"):
        PhotoRecord.from_json(value)
