"""Real photos, where they are at hand: the numbers that the cameras printed into their pictures are
the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mrgs.data.radiometric import read_thermal_photo

PHOTOS = Path(__file__).parents[4] / "shared/radiometric"
pytestmark = pytest.mark.skipif(
    not PHOTOS.is_dir(), reason="the real photos do not lie beside the repository"
)

# Beside each photo: its camera, size, and the ends of the printed colour scale with their unit and
# tolerance. Live pictures of moving cars, and cameras that cut decimals off, differ from their
# record by up to one printed step.
PRINTED = {
    "01_200_deg_neutral": ("InfraCAM Wester", (120, 120), (90, 161), "F", 1.0),
    "03_Thermal_image_of_four_ducks_swimming": ("FLIR_i7", (120, 120), (45, 64), "F", 0.5),
    "05_Aqua_Tower_thermal_image": ("Flir b60", (180, 180), (9, 33), "F", 0.5),
    "06_Aqua_Tower_thermal_imaging": ("Flir b60", (180, 180), (9.0, 25.8), "F", 0.05),
    "10_IR_Fussbodenheizung": ("FLIR E60", (240, 320), (17, 25), "C", 0.5),
    "11_IR_moving_car": ("FLIR E60", (240, 320), (-11, 13), "C", 1.05),
    "12_IR_moving_mercedes": ("FLIR E60", (240, 320), (-3, 12), "C", 1.05),
    "15_Linear_load": ("InfraCAM Wester", (120, 120), (88, 171), "F", 0.5),
    "17_Solar_halo_thermal": ("FLIR T420 (incl Wi-", (240, 320), (-32.0, 0.0), "C", 0.05),
}


def photo(name: str):
    return read_thermal_photo(PHOTOS / f"{name}.jpg")


@pytest.mark.parametrize("name", PRINTED)
def test_the_printed_scale(name):
    camera, size, printed, unit, tolerance = PRINTED[name]
    read = photo(name)
    assert read.facts.camera == camera
    assert read.temperature_c.shape == size
    assert read.valid.all()
    scale = np.array(read.facts.scale_c)
    np.testing.assert_allclose(scale * 1.8 + 32 if unit == "F" else scale, printed, atol=tolerance)


@pytest.mark.parametrize(
    ("name", "spot_c", "tolerance_c"),
    [
        ("05_Aqua_Tower_thermal_image", (19.0 - 32) / 1.8, 0.3),
        ("10_IR_Fussbodenheizung", 21.1, 0.05),
    ],
)
def test_the_printed_spot_of_a_still_scene(name, spot_c, tolerance_c):
    celsius = photo(name).temperature_c
    row, column = celsius.shape[0] // 2 - 1, celsius.shape[1] // 2 - 1
    assert np.abs(celsius[row : row + 2, column : column + 2] - spot_c).min() < tolerance_c


def test_the_printed_hottest_spot_of_an_area():
    area = photo("03_Thermal_image_of_four_ducks_swimming").temperature_c[40:80, 40:80]
    assert area.max() * 1.8 + 32 == pytest.approx(72.7, abs=1.5)


def test_the_visible_photo():
    visible = photo("05_Aqua_Tower_thermal_image").facts.visible
    pixels = visible.pixels().astype(int)
    assert pixels.shape == (480, 480, 3)
    sky = pixels[20:60, 30:100].mean(axis=(0, 1))
    assert (
        sky[2] > sky[1] > sky[0] > 100
    )  # blue, as a winter sky is; luma and chroma taken for RGB would be orange
