from __future__ import annotations

import struct
from datetime import datetime
from pathlib import PurePosixPath

import numpy as np
import pytest

from mrgs.prepare.pairs.inventory import inspect
from mrgs.prepare.pairs.photo import Photo
from tests.helpers.flir import FlirPhoto
from tests.helpers.photos import photo

NOON = datetime(2024, 5, 1, 12, 0, 0)


@pytest.fixture
def seen(tmp_path):
    """What is seen of a file with the given name and content."""

    def look(name: str, content: bytes) -> Photo | str:
        (tmp_path / name).write_bytes(content)
        return inspect(tmp_path / name, PurePosixPath("folder", name))

    return look


def test_a_plain_photo(seen):
    found = seen("a.jpg", photo("jpg", size=(20, 10), taken=NOON, model="X100", focal_mm=23.0))
    assert (found.kind, found.size, found.is_thermal, found.embedded) == (
        "image",
        (20, 10),
        False,
        False,
    )
    assert (found.exif.taken, found.exif.model, found.focal_mm) == (NOON, "X100", 23.0)
    assert found.origin == PurePosixPath("folder/a")


def test_a_flir_photo(seen):
    found = seen("a.jpg", photo("flir", taken=NOON))
    assert (found.kind, found.is_thermal, found.embedded) == ("signal", True, False)
    assert found.exif.taken == NOON
    assert seen("b.jpg", photo("flir with visible")).embedded


def test_a_bare_flir_record(seen):
    view = {0x1B4: struct.pack("<f", 25.0)}
    found = seen("a.fff", FlirPhoto(info_fields=view).record())
    assert (found.kind, found.serial, found.field_of_view_deg) == ("signal", "4711", 25.0)
    assert found.exif.taken == datetime(2013, 3, 12, 16, 31, 23, 250_000)
    assert found.exif.model == "Test Camera"


def test_a_flir_record_without_camera_says_nothing_of_it(seen):
    found = seen("a.fff", FlirPhoto(without=(0x20,)).record())
    assert (found.kind, found.serial, found.exif.taken) == ("signal", None, None)


def test_a_flir_photo_that_is_cut_off(seen):
    whole = FlirPhoto(part_bytes=500).jpeg()
    assert seen("a.jpg", whole[:1400]).startswith("its thermal record is cut off or damaged")


def test_a_record_without_raw_image_belongs_to_a_visible_photo(seen):
    assert seen("DC_0001.jpg", FlirPhoto(without=(0x01,)).jpeg()).kind == "image"


def test_numbers(seen):
    assert seen("a.tif", photo("celsius")).kind == "numbers"
    assert seen("a.raw", np.zeros(160 * 120, np.float32).tobytes()).kind == "numbers"


def test_a_dji_photo(seen):
    found = seen("a.jpg", photo("dji", model="DJI M3T"))
    assert (found.kind, found.needs_tool) == ("signal", True)


def test_a_table(seen):
    assert seen("a.csv", b"\n".join([b"1,5;" * 20] * 4)).kind == "table"
    assert (
        seen("a.txt", b"20\t21\t22\t23\t24\t25\t26\t27\t28\n".decode().encode("utf-16")).kind
        == "table"
    )


def test_a_photo_with_a_long_header_is_read_whole(seen):
    data = photo("jpg", size=(20, 10))
    filler = b"".join(b"\xff\xe5" + struct.pack(">H", 65_002) + bytes(65_000) for _ in range(18))
    assert seen("a.jpg", data[:2] + filler + data[2:]).size == (20, 10)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.jpg", b"", "empty"),
        ("a.jpg", b"\xff\xd8\xff\xe0 no", "decoded"),
        ("a.png", b"\x89PNG\r\n\x1a\n no", "decoded"),
        ("a.heic", b"ftypheic", "HEIC"),
        ("a.csv", b"rgb,thermal\na,b\n", "not a photo"),
        ("a.raw", b"1234", "not a photo"),
        ("flight.mp4", b"1234", "not a photo"),
    ],
)
def test_what_cannot_be_used(seen, name, content, reason):
    assert reason in seen(name, content)


def test_a_file_that_is_gone(tmp_path):
    assert "No such file" in inspect(tmp_path / "a.jpg", PurePosixPath("a.jpg"))
