"""What rounding leaves in the mean of many values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.marks.photo_readings import (
    OF_ONE_VALUE,
    PhotoReadings,
    _step_of,
    block_variances,
    rounding_of_mean,
)
from mrgs.scene import THERMAL, Pixels, PosedImage, View, ideal_cameras
from tests.corpus.tiffs import METADATA, scaled_by_gdal
from tests.helpers.walls import RANGE, camera_before_wall, render_wall

STEP_C = RANGE.span_c / 255


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2, 0.3, 0.5])
def test_it_is_twice_the_error_of_a_mean_of_rounded_values(noise):
    true = np.linspace(0.0, 1.0, 200, endpoint=False)
    normal = np.random.default_rng(0).normal(size=(20_000, 1))
    error = np.round(true + noise * normal).mean(axis=0) - true
    assert rounding_of_mean(noise**2) == pytest.approx(2 * np.sqrt(np.mean(error**2)), abs=0.01)


def test_without_noise_a_mean_is_no_better_than_one_value():
    assert rounding_of_mean(0.0) == pytest.approx(OF_ONE_VALUE, rel=0.01)


def test_blocks_with_masked_pixels_are_left_out():
    values = np.tile(np.array([0.0, 1.0], np.float32), (17, 12))
    values[3, 3] = np.nan
    np.testing.assert_allclose(block_variances(values), np.full(5, 0.25))


def rounded_photo(number: int, noise: float, folder: Path) -> View:
    """A photo of the wall in 8 bits, with noise of so many steps."""
    camera = camera_before_wall(number - 1.0)
    values = 255 * render_wall(camera)[THERMAL].image
    rng = np.random.default_rng(number)
    values = values + noise * torch.from_numpy(rng.normal(size=tuple(values.shape)))
    grey = values.round().clamp(0, 255).to(torch.uint8)
    file = folder / f"{number}.png"
    Image.fromarray(grey[..., 0].numpy()).save(file)
    return View(
        f"v{number}",
        {THERMAL: PosedImage(camera, lambda: Pixels(grey.float() / 255), files=(file,))},
    )


def part_of_photos(noise: float, folder: Path) -> float:
    views = [rounded_photo(number, noise, folder) for number in range(3)]
    witnesses = PhotoReadings(render_wall, ideal_cameras, views, RANGE)
    x, z = np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 20, dtype=np.float32)])
    points = np.stack([x.ravel(), np.zeros(400, np.float32), z.ravel()], axis=1)
    return float(witnesses.of_mark(points, 20.0).photos[0])


def test_coarse_steps_count_for_a_mark_where_noise_does_not_average_them(tmp_path):
    assert part_of_photos(0.05, tmp_path) > 0.9 * rounding_of_mean(0.05**2) * STEP_C
    assert part_of_photos(0.8, tmp_path) < 0.5 * OF_ONE_VALUE * STEP_C


def test_integers_with_a_scale_are_as_fine_as_it(tmp_path):
    camera, file = camera_before_wall(0.0), tmp_path / "0.tif"
    tag = {METADATA: scaled_by_gdal(0.5, 0)}
    Image.fromarray(np.full((4, 5), 40, np.uint16)).save(file, tiffinfo=tag)
    view = View(
        "v", {THERMAL: PosedImage(camera, lambda: Pixels(torch.zeros(4, 5, 1)), files=(file,))}
    )
    assert _step_of([view], RANGE.span_c) == 0.5
    assert _step_of([], RANGE.span_c) == 0
