from __future__ import annotations

import io
from datetime import datetime

import pytest
from PIL import Image, TiffImagePlugin
from PIL.TiffImagePlugin import IFDRational

from mrgs.data.radiometric import ExifFacts, GpsPosition, read_exif


def with_exif(gps: dict | None = None, form: str = "JPEG", **tags) -> bytes:
    exif = TiffImagePlugin.ImageFileDirectory_v2() if form == "TIFF" else Image.Exif()
    for tag, value in tags.items():
        exif[int(tag[1:])] = value
    if gps is not None:
        exif[0x8825] = gps
    file = io.BytesIO()
    Image.new("L", (2, 2)).save(file, form, **{"tiffinfo" if form == "TIFF" else "exif": exif})
    return file.getvalue()


@pytest.mark.parametrize("form", ["JPEG", "PNG", "TIFF"])
def test_facts(form):
    data = with_exif(
        {1: "N", 2: (48, 30, 0), 3: "W", 4: (9, 15, 36), 5: b"\0", 6: 430.5},
        form,
        t271="Maker",
        t306="2020:01:02 03:04:05",
    )
    assert read_exif(data) == ExifFacts(
        "Maker", None, datetime(2020, 1, 2, 3, 4, 5), GpsPosition(48.5, -9.26, 430.5)
    )


@pytest.mark.parametrize(
    "gps",
    [
        {1: "N", 2: (48, 30, 0)},
        {1: "X", 2: (48, 30, 0), 3: "E", 4: (9, 0, 0)},
        {1: "N", 2: (98, 30, 0), 3: "E", 4: (9, 0, 0)},
        {1: "N", 2: (IFDRational(0, 0), 0, 0), 3: "E", 4: (9, 0, 0)},
        {1: "N", 2: (0, 0, 0), 3: "E", 4: (0, 0, 0)},
    ],
)
def test_positions_that_cannot_be_are_none(gps):
    assert read_exif(with_exif(gps)).gps is None


def test_an_altitude_that_cannot_be_leaves_the_place():
    gps = {1: "N", 2: (48, 0, 0), 3: "E", 4: (9, 0, 0), 6: IFDRational(0, 0)}
    assert read_exif(with_exif(gps)).gps == GpsPosition(48, 9, None)


@pytest.mark.parametrize("time", ["0000:00:00 00:00:00", "yesterday", ""])
def test_times_that_cannot_be_are_none(time):
    assert read_exif(with_exif(t306=time)).taken is None


EARLY, LATE = datetime(2024, 5, 1, 12, 0, 0), datetime(2024, 5, 1, 12, 0, 9)


def at(moment: datetime) -> str:
    return moment.strftime("%Y:%m:%d %H:%M:%S")


@pytest.mark.parametrize(
    ("photo", "taken"),
    [
        ({0x9003: at(EARLY), 0x9291: "25"}, EARLY.replace(microsecond=250_000)),
        ({0x9003: "0000:00:00 00:00:00", 0x9291: "25"}, LATE),
        ({0x9003: "    :  :     :  :  "}, LATE),
        ({0x9003: "", 0x9290: "5"}, LATE.replace(microsecond=500_000)),
        ({0x9003: " ", 0x9004: at(EARLY), 0x9292: "125"}, EARLY.replace(microsecond=125_000)),
        ({}, LATE),
    ],
)
def test_a_time_that_was_not_set_does_not_hide_another(photo, taken):
    assert read_exif(with_exif(t306=at(LATE), t34665=photo)).taken == taken


def test_damage_makes_facts_none():
    assert read_exif(b"\xff\xd8\xff\xe1\0\x08Exif\0\0") == ExifFacts()
