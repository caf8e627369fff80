"""Thermal images whose local contrast is made even, so that features are found in them."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from mrgs.prepare.sfm.reconstruct import evened, local_contrast

ROWS, COLUMNS = np.indices((192, 256))
SQUARES = (20 + 0.5 * ((ROWS // 12 + COLUMNS // 12) % 2)).astype(np.float32)
"""Squares that differ by half a degree."""


def grey(path, celsius: np.ndarray) -> np.ndarray:
    Image.fromarray(celsius.astype(np.float32)).save(path)
    return evened(path).astype(float)


def test_faint_edges_become_strong_beside_a_lamp(tmp_path):
    celsius = SQUARES.copy()
    celsius[:16, :16] = 80
    image = grey(tmp_path / "a.tiff", celsius)
    assert image[50:150, 80:220].std() > 15


@pytest.mark.parametrize(
    "change",
    [
        lambda celsius: celsius - 5,
        lambda celsius: celsius + 2 * ((COLUMNS - 128) ** 2 + (ROWS - 96) ** 2) / 160**2,
    ],
    ids=["drift", "shading"],
)
def test_what_the_camera_adds_hardly_shows(tmp_path, change):
    image = grey(tmp_path / "a.tiff", SQUARES)
    other = grey(tmp_path / "b.tiff", change(SQUARES))
    assert (image - other)[16:-16, 16:-16].std() < 0.1 * image[16:-16, 16:-16].std()


def test_the_noise_of_a_flat_surface_stays_fainter_than_edges(tmp_path):
    noise = np.random.default_rng(0).normal(0, 0.05, SQUARES.shape)
    half = np.where(COLUMNS < 128, SQUARES, 20) + noise
    image = grey(tmp_path / "a.tiff", half)
    assert image[20:-20, 190:230].std() < 0.5 * image[20:-20, 20:90].std()


def test_pixels_without_temperature_leave_no_edge(tmp_path):
    celsius = np.full((40, 40), 12.0)
    celsius[10:20] = np.nan
    assert (grey(tmp_path / "a.tiff", celsius) == 128).all()


@pytest.mark.parametrize("shape", [(4, 4), (7, 60), (96, 128)])
def test_shares_stay_in_range(shape):
    values = np.random.default_rng(0).uniform(-40, 120, shape).astype(np.float32)
    result = local_contrast(values)
    assert result.shape == shape
    assert 0 <= result.min() <= result.max() <= 1
