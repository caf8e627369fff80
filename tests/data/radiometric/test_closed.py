"""Formats whose temperatures only the maker's program reads are refused, with that program."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import pytest
from PIL import Image

from mrgs.data.radiometric import read_thermal_photo
from mrgs.errors import SceneError


def jpeg() -> bytes:
    stream = BytesIO()
    Image.new("RGB", (16, 12)).save(stream, "JPEG")
    return stream.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "program"),
    [
        ("a.irb", b"\xffIRB\0IRBACS" + bytes(64), "IRBIS"),
        ("a.jpg", jpeg() + b"HDRI" + bytes(64) + b"HIPT", "HIKMICRO"),
        ("a.jpg", jpeg()[:2] + b"\xff\xe2\0\x10\0\0IJPEG\0" + bytes(6) + jpeg()[2:], "TIFF or CSV"),
        ("a.BMT", b"BM" + bytes(64), "IRSoft"),
        ("a.is2", b"PK\3\4" + bytes(64), "Fluke"),
    ],
)
def test_the_program_that_exports_temperatures_is_named(
    tmp_path: Path, name: str, data: bytes, program: str
) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SceneError, match=program):
        read_thermal_photo(tmp_path / name)


def test_a_picture_without_such_a_record_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg())
    assert read_thermal_photo(tmp_path / "a.jpg").valid.shape == (12, 16)
