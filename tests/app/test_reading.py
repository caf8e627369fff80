"""``mrgs read``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs.app.cli import main
from tests.helpers.flir import FlirPhoto


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    values = np.full((12, 16), 14.5)
    values[3, 5], values[7, 2], values[0, 0] = -2.25, 31.5, np.nan
    np.savetxt(tmp_path / "photo.csv", values, fmt="%.2f", delimiter=";")
    return tmp_path / "photo.csv"


def test_what_a_photo_says_is_printed(photo, capsys):
    assert main(["read", str(photo)]) == 0
    printed = capsys.readouterr().out
    assert "16×12 pixels" in printed
    assert "−2.25 to 31.50 °C, median 14.50 °C" in printed
    assert "−2.25 °C in column 5, row 3" in printed
    assert "31.50 °C in column 2, row 7" in printed
    assert "1 of 192 pixels" in printed


def test_settings_of_the_camera_are_printed(tmp_path, capsys):
    (tmp_path / "photo.jpg").write_bytes(FlirPhoto().jpeg())
    assert main(["read", str(tmp_path / "photo.jpg"), "--emissivity", "0.6"]) == 0
    printed = capsys.readouterr().out
    assert "camera:       Test Camera, " in printed
    assert "emissivity:   0.6, reflecting " in printed
    assert " % humidity" in printed


@pytest.mark.parametrize("name", ["out.csv", "out.tiff"])
def test_temperatures_are_written_as_they_are_read_again(photo, tmp_path, name, capsys):
    target = tmp_path / name
    assert main(["read", str(photo), "--unit", "fahrenheit", "--output", str(target)]) == 0
    assert capsys.readouterr().out.endswith(f"written: {target}\n")
    if name == "out.tiff":
        written = np.asarray(Image.open(target))
    else:
        written = np.genfromtxt(target, delimiter=",")
    assert written.shape == (12, 16)
    assert np.isnan(written[0, 0])
    assert written[7, 2] == pytest.approx((31.5 - 32) / 1.8, abs=1e-3)


def test_the_photo_itself_is_not_overwritten(photo, capsys):
    before = photo.read_bytes()
    assert main(["read", str(photo), "--unit", "kelvin", "--output", str(photo)]) == 2
    assert "the photo itself" in capsys.readouterr().err
    assert photo.read_bytes() == before


def test_what_cannot_be_written_is_refused(tmp_path, capsys):
    grey = tmp_path / "grey.png"
    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(12, 16)).save(grey)
    assert main(["read", str(grey)]) == 0
    assert "brightness alone" in capsys.readouterr().out
    assert main(["read", str(grey), "--output", str(tmp_path / "out.csv")]) == 2
    assert "--unit" in capsys.readouterr().err
    assert main(["read", str(grey), "--output", str(tmp_path / "out.png")]) == 2
    assert "a .csv or a .tiff" in capsys.readouterr().err
    assert not [*tmp_path.glob("out.*")]
