"""DJI: R-JPEGs are told apart, and what DJI's tool makes of them is read."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from mrgs.data.radiometric import read_thermal_photo
from mrgs.data.radiometric.dji import SIZES
from mrgs.errors import SceneError


def drone_photo(path, signal_bytes: int, make: str = "DJI"):
    exif = Image.Exif()
    exif[0x010F] = make
    Image.new("RGB", (64, 51), (90, 20, 120)).save(path, exif=exif)
    data = path.read_bytes()
    segment = b"\xff\xe3" + (signal_bytes + 2).to_bytes(2, "big") + bytes(signal_bytes)
    path.write_bytes(data[:2] + segment + data[2:])
    return path


def test_an_r_jpeg_names_the_tool_that_converts_it(tmp_path):
    path = drone_photo(tmp_path / "DJI_0001_T.JPG", 60_000)
    command = r"dji_irp -s DJI_0001_T.JPG -a measure -o DJI_0001_T.raw --measurefmt float32"
    with pytest.raises(SceneError, match=f"is a DJI R-JPEG.* convert it with {command}"):
        read_thermal_photo(path)


@pytest.mark.parametrize(("signal_bytes", "make"), [(100, "DJI"), (60_000, "Canon")])
def test_other_photos_are_pictures_without_temperatures(tmp_path, signal_bytes, make):
    photo = read_thermal_photo(drone_photo(tmp_path / "a.jpg", signal_bytes, make))
    assert photo.temperature_c is None
    assert photo.relative.shape == (51, 64)


def test_all_sizes_differ_in_bytes():
    sizes = [width * height * bytes_ for width, height in SIZES for bytes_ in (2, 4)]
    assert len(set(sizes)) == len(sizes)


@pytest.mark.parametrize(("form", "factor"), [("<f4", 1), ("<i2", 10)])
def test_bare_numbers(save, form, factor):
    celsius = np.linspace(-12, 45, 512 * 640).reshape(512, 640)
    photo = read_thermal_photo(
        save("a.raw", np.rint(celsius * 10 / (10 / factor)).astype(form).tobytes())
    )
    np.testing.assert_allclose(photo.temperature_c, celsius, atol=0.51 if factor == 1 else 0.051)
    assert photo.facts.source == "output of DJI's Thermal SDK"


def test_bare_numbers_of_another_length(save):
    with pytest.raises(SceneError, match="has 1000 bytes, which is no image of a DJI camera"):
        read_thermal_photo(save("a.raw", bytes(1000)))
