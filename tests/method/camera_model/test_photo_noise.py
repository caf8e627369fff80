from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mrgs.method.config import make_config
from mrgs.method.losses.photometric import LossConfig
from mrgs.method.losses.term import NOISE_PHOTOS, SceneScale, photo_contrast, photo_noise
from mrgs.scene import RGB, THERMAL, Pixels, PointCloud, PosedImage, Scene, View
from tests.helpers.views import posed_image


def pixels(values: Tensor, valid: Tensor | None = None) -> Pixels:
    return posed_image(values, valid).load()


def edges_and_slopes() -> Tensor:
    rows, columns = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    slope = 0.2 + 0.003 * rows - 0.001 * columns
    return torch.where((rows > 30) & (columns > 20) & (columns < 55), slope + 0.4, slope)[..., None]


def noisy(sigma: float, seed: int = 0) -> Tensor:
    values = edges_and_slopes()
    generator = torch.Generator().manual_seed(seed)
    return values + sigma * torch.randn(values.shape, generator=generator)


@pytest.mark.parametrize("sigma", [0.0, 0.002, 0.03])
def test_the_noise_is_told_from_the_scene(sigma):
    photos = [pixels(noisy(sigma, seed)) for seed in range(3)]
    assert photo_noise(photos) == pytest.approx(sigma, rel=0.05, abs=1e-6)


def test_interpolated_noise_is_noise():
    """A detector of half as many pixels in each direction; between two of them it is less."""
    generator = torch.Generator().manual_seed(0)
    detector = 0.02 * torch.randn(1, 1, 60, 80, generator=generator)
    written = torch.nn.functional.interpolate(detector, scale_factor=2, mode="bilinear")
    photo, sigma = pixels(0.5 + written[0, 0, :, :, None]), written.std().item()
    assert photo_noise([photo], 3) == pytest.approx(sigma, rel=0.1)
    assert photo_noise([photo]) < 0.6 * sigma


def test_photos_too_small_to_tell_have_no_noise():
    assert photo_noise([pixels(torch.rand(6, 80, 1))], 3) == 0


def test_invalid_pixels_do_not_count():
    values, valid = noisy(0.002), torch.ones(60, 80, dtype=torch.bool)
    values[:40], valid[:40] = noisy(0.3)[:40], False
    assert photo_noise([pixels(values, valid)]) == pytest.approx(0.002, rel=0.1)
    assert photo_noise([pixels(values, torch.zeros_like(valid))]) == 0


def test_without_photos_there_is_no_noise():
    assert photo_noise([]) == 0


def test_neither_a_lamp_nor_drift_is_contrast():
    rows = torch.linspace(0.1, 0.2, 60)[:, None, None].expand(60, 80, 1)
    lamp = rows.clone()
    lamp[:5, :5] = 0.9
    drifted, valid = rows + 0.3, torch.ones(60, 80, dtype=torch.bool)
    drifted[40:], valid[40:] = 7.0, False
    contrast = photo_contrast([pixels(rows), pixels(lamp), pixels(drifted, valid)])
    assert contrast == pytest.approx(0.09, rel=0.03)
    assert photo_contrast([]) == photo_contrast([pixels(rows, torch.zeros_like(valid))]) == 0


def test_some_photos_tell_for_all():
    read = []

    def noted(index: int) -> PosedImage:
        image = posed_image(noisy(0.01))
        return PosedImage(image.camera, lambda: read.append(index) or image.load())

    views = [View(str(index), {THERMAL: noted(index)}) for index in range(100)]
    SceneScale.of(Scene("scene", tuple(views), (), PointCloud(*torch.zeros(2, 4, 3)), None))
    assert len(read) == NOISE_PHOTOS
    assert (read[0], read[-1]) == (0, 99)


def test_noisy_or_few_temperatures_are_smoothed_more():
    loss = make_config("mrgs-plus", "fast").loss
    assert loss.smooth_noise is not None
    assert loss.smooth_image(THERMAL, loss.smooth_noise / 2, 1.0) == (0, loss.smooth_alike)
    noise = loss.smooth_noise + 0.01
    assert loss.smooth_image(THERMAL, noise, 1.0) == pytest.approx((0.3125, loss.smooth_alike))
    assert loss.smooth_image(THERMAL, 0.0, 9.0) == pytest.approx((0, 3 * loss.smooth_alike))
    assert loss.smooth_image(RGB, 0.03, 3.0) == (loss.smooth_rgb, 0)


def test_the_smoothness_of_mrgs_grows_in_proportion_to_noise():
    loss = make_config("mrgs", "fast").loss
    for noise, times in ((0.0, 1), (0.002, 1), (0.004, 2), (0.032, 16)):
        expected = times * loss.smooth_thermal, 0
        assert loss.smooth_image(THERMAL, noise, 1.0) == pytest.approx(expected)


def test_as_published_neither_noise_nor_number_matters():
    assert LossConfig().smooth_image(THERMAL, 0.3, 4.0) == (1, 0)


@pytest.mark.parametrize(
    ("width", "thermal_photos", "expected"),
    [(32, 9, 1.0), (8, 9, 1.0), (32, 1, 9.0), (64, 3, 3.0), (32, 0, 1.0)],
    ids=["alike", "a quarter of the resolution", "one of nine", "finer", "none"],
)
def test_rgb_photos_per_thermal_photo(width, thermal_photos, expected):
    color, heat = torch.zeros(24, 32, 3), torch.zeros(width * 3 // 4, width, 1)
    views = [
        View(
            str(index),
            {RGB: posed_image(color)}
            | ({THERMAL: posed_image(heat)} if index < thermal_photos else {}),
        )
        for index in range(9)
    ]
    points = PointCloud(torch.zeros(4, 3), torch.zeros(4, 3))
    scene = Scene("scene", tuple(views), (), points, None)
    assert SceneScale.of(scene).rgb_per_thermal == pytest.approx(expected)
    assert SceneScale.of(scene).thermal_noise == 0


@pytest.mark.parametrize(("width", "distance_px"), [(64, 3), (32, 2), (16, 1)])
def test_the_coarser_photos_are_the_less_are_they_taken_to_be_interpolated(width, distance_px):
    generator = torch.Generator().manual_seed(0)
    heat = torch.rand(width * 3 // 4, width, 1, generator=generator)
    views = [View("0", {RGB: posed_image(torch.zeros(48, 64, 3)), THERMAL: posed_image(heat)})]
    points = PointCloud(torch.zeros(4, 3), torch.zeros(4, 3))
    noise = SceneScale.of(Scene("scene", tuple(views), (), points, None)).thermal_noise
    assert noise == photo_noise([pixels(heat)], distance_px)
