"""Each part of a thermal camera does what it says, and nothing without its number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import j1

from mrgs.errors import ConfigError
from mrgs_synth.drift import Drift
from mrgs_synth.imager import CAMERAS, HOT_PIXEL_C, Detector, ThermalImager, named_imager
from mrgs_synth.optics import diffraction_mtf
from mrgs_synth.planck import band_radiance, radiance_per_degree, temperature

PERFECT = ThermalImager()
RAYS = 4
GREY = np.full((48, 64, 3), 128, np.uint8)


def seen_c(
    imager: ThermalImager, rays_c: np.ndarray, depth_m: float | np.ndarray = 2.0
) -> np.ndarray:
    """What the detector's pixels collect, as temperatures; in focus at 2 m."""
    depth = np.broadcast_to(np.asarray(depth_m, float), rays_c.shape)
    return temperature(imager.exposed(rays_c, depth, 2.0, 1200.0, RAYS))


def written(
    imager: ThermalImager, celsius: np.ndarray, drift_c: float = 0.0, photo: np.ndarray = GREY,
    frame: int = 0, reference_c: float = 20.0,
) -> np.ndarray:  # fmt: skip
    detector = Detector.of(imager, celsius.shape, reference_c, np.random.default_rng(1))
    return detector.photo(band_radiance(celsius), drift_c, photo, np.random.default_rng([2, frame]))


def flat(celsius: float = 20.0, height: int = 48, width: int = 64) -> np.ndarray:
    return np.full((height, width), celsius)


def waves(cycles_per_pixel: float, width: int = 64, enlargement: int = 1) -> np.ndarray:
    """Small waves across an image, phased so that the mirrored image continues them."""
    x = (np.arange(width * RAYS * enlargement) + 0.5) / (RAYS * enlargement)
    row = 20.0 + 0.1 * np.cos(2.0 * np.pi * cycles_per_pixel * x)
    return np.repeat(row[None], 16 * RAYS * enlargement, axis=0)


def modulation(image: np.ndarray, cycles_per_pixel: float) -> float:
    x = np.arange(image.shape[1]) + 0.5
    row = image.mean(axis=0) - 20.0
    return float(2.0 * (row * np.cos(2.0 * np.pi * cycles_per_pixel * x)).mean() / 0.1)


@pytest.mark.parametrize("celsius", [-60.0, 20.0, 80.0, 600.0])
def test_band_radiance_is_the_integral_of_plancks_law(celsius: float) -> None:
    def law(um: float) -> float:
        return 1.191042972e8 / um**5 / np.expm1(14387.76877 / (um * (celsius + 273.15)))

    assert band_radiance(np.array(celsius)) == pytest.approx(quad(law, 7.5, 13.0)[0], rel=1e-5)


@given(st.floats(-100.0, 1000.0))
def test_a_temperature_is_read_back_from_its_radiance(celsius: float) -> None:
    assert temperature(band_radiance(np.array(celsius))) == pytest.approx(celsius, abs=1e-6)


def test_a_pixel_half_of_20_and_half_of_80_degrees_reads_more_than_their_mean() -> None:
    """53.5 °C at 10 µm alone; 53.7 °C over the band."""
    rays_c = np.tile([20.0, 80.0, 80.0, 20.0], (64, 16))
    np.testing.assert_allclose(seen_c(PERFECT, rays_c), 53.70, atol=0.01)


def test_diffraction_is_the_overlap_of_two_pupils() -> None:
    y, x = np.mgrid[-1.5:1.5:601j, -1.5:1.5:601j]
    for s in (0.0, 0.2, 0.5, 0.9, 1.0):
        both = (np.hypot(x - s, y) < 1.0) & (np.hypot(x + s, y) < 1.0)
        expected = both.sum() / (np.hypot(x, y) < 1.0).sum()
        assert diffraction_mtf(np.array(3.0 * s), 3.0) == pytest.approx(expected, abs=0.005)


@pytest.mark.parametrize("camera", list(CAMERAS))
@pytest.mark.parametrize("frequency", [0.125, 0.25])
def test_a_lens_and_its_detector_pass_the_contrast_that_physics_leaves(
    camera: str, frequency: float
) -> None:
    imager = CAMERAS[camera]
    image = seen_c(imager, waves(frequency, enlargement=imager.enlargement))
    lens = float(diffraction_mtf(np.array(frequency), imager.cutoff))
    assert modulation(image, frequency) == pytest.approx(lens * np.sinc(frequency), rel=0.01)


def test_defocus_depends_on_the_depth_of_each_pixel() -> None:
    """|1/z − 1/z_focus|: at 1 m as much as at infinity, if 2 m are in focus."""
    imager = replace(PERFECT, aperture_mm=10.0)
    radius_px = 1200.0 / RAYS * 0.005 * 0.5
    disc = 2.0 * j1(2.0 * np.pi * radius_px * 0.25) / (2.0 * np.pi * radius_px * 0.25)
    rays_c = waves(0.25)
    sharp = modulation(seen_c(imager, rays_c), 0.25)
    for depth_m in (1.0, 0.0):
        blurred = modulation(seen_c(imager, rays_c, depth_m), 0.25)
        assert blurred == pytest.approx(disc * sharp, rel=0.01)
    depth = np.where(np.arange(rays_c.shape[1]) < 128, 2.0, 1.0) * np.ones_like(rays_c)
    halves = seen_c(imager, rays_c, depth)
    assert modulation(halves[:, :24], 0.25) == pytest.approx(sharp, rel=0.02)
    assert modulation(halves[:, 40:], 0.25) == pytest.approx(disc * sharp, rel=0.02)


def test_a_uniform_scene_stays_uniform_whatever_its_depths() -> None:
    depth = np.random.default_rng(0).uniform(0.2, 5.0, (64, 256))
    imager = replace(PERFECT, aperture_mm=16.0)
    np.testing.assert_allclose(seen_c(imager, np.full(depth.shape, 21.5), depth), 21.5, atol=1e-6)


def test_the_perfect_camera_writes_what_it_sees() -> None:
    celsius = np.random.default_rng(0).uniform(-20.0, 90.0, (48, 64))
    np.testing.assert_allclose(written(PERFECT, celsius), celsius, atol=1e-6)


def test_drift_is_added_to_the_radiance() -> None:
    """Its degrees apply at the reference temperature; where it is colder they are more."""
    for celsius in (20.0, -30.0):
        image = written(PERFECT, flat(celsius), 3.0)
        added = band_radiance(image) - band_radiance(flat(celsius))
        np.testing.assert_allclose(added, 3.0 * radiance_per_degree(20.0), rtol=1e-6)
    assert written(PERFECT, flat(), 3.0)[0, 0] == pytest.approx(23.0, abs=0.1)
    assert image[0, 0] > -25.0


def test_corners_read_less_than_the_centre_in_all_photos() -> None:
    imager = replace(PERFECT, shading_c=1.0)
    image = written(imager, flat())
    corners = np.mean([image[i, j] for i in (0, -1) for j in (0, -1)])
    assert image[23:25, 31:33].mean() - corners == pytest.approx(1.0, abs=0.05)
    assert image.mean() == pytest.approx(20.0, abs=0.01)
    np.testing.assert_array_equal(image, written(imager, flat(), frame=1))


def test_the_fixed_pattern_stays_and_the_noise_does_not() -> None:
    pattern = replace(PERFECT, pattern_c=0.1, column_c=0.2)
    first, second = (written(replace(pattern, netd_c=0.05), flat(), frame=n) for n in (0, 1))
    assert (first - second).std() == pytest.approx(0.05 * np.sqrt(2.0), rel=0.05)
    common = written(pattern, flat()) - 20.0
    assert common.mean(axis=0).std() == pytest.approx(0.2, rel=0.3)
    assert (common - common.mean(axis=0)).std() == pytest.approx(0.1, rel=0.05)
    assert np.corrcoef((first + second).ravel(), common.ravel())[0, 1] > 0.95


def test_defective_pixels_are_replaced_but_for_a_few() -> None:
    gradient = 20.0 + 0.1 * np.arange(64.0) + flat(0.0)
    hidden = written(replace(PERFECT, defective=0.05), gradient)
    assert 100 < (np.abs(hidden - gradient) > 1e-6).sum() < 250
    np.testing.assert_allclose(hidden, gradient, atol=0.1)
    error = written(replace(PERFECT, defective=0.05, missed=0.2), gradient, reference_c=10.0)
    error -= gradient
    hot, dead = error > 5.0, error < -5.0
    assert hot.sum() > 5
    assert dead.sum() > 5
    np.testing.assert_allclose((error + gradient)[dead], 10.0, atol=1e-6)
    added = (band_radiance(error + gradient) - band_radiance(gradient))[hot]
    np.testing.assert_allclose(added, HOT_PIXEL_C * radiance_per_degree(10.0), rtol=1e-6)


def test_sharpening_overshoots_at_an_edge() -> None:
    step = np.where(np.arange(64) < 32, 20.0, 30.0) + flat(0.0)
    image = written(replace(PERFECT, sharpening=0.5), step)
    assert image.max() > 31.0
    assert image.min() < 19.0
    np.testing.assert_allclose(image[:, [0, -1]], step[:, [0, -1]], atol=1e-6)


def test_edges_of_the_photo_are_pressed_into_the_thermal_image() -> None:
    photo = np.where(np.arange(64)[None, :, None] < 32, 0, 255) * np.ones((48, 1, 3))
    image = written(replace(PERFECT, edges_c=2.0), flat(), photo=photo.astype(np.uint8))
    across = image[24] - 20.0
    assert across[31] == pytest.approx(-across[32], abs=1e-6)
    assert 0.5 < across[32] < 1.0
    np.testing.assert_allclose(across[[5, -5]], 0.0, atol=1e-3)


def test_a_small_detector_is_enlarged() -> None:
    small = np.random.default_rng(0).uniform(20.0, 30.0, (12, 16))
    image = written(replace(PERFECT, enlargement=4), small)
    assert image.shape == (48, 64)
    np.testing.assert_allclose(
        image.reshape(12, 4, 16, 4).mean(axis=(1, 3))[1:-1, 1:-1].mean(),
        small[1:-1, 1:-1].mean(), atol=0.3,
    )  # fmt: skip
    between = np.diff(image, n=2, axis=1)[:, 2:-2].reshape(48, -1)
    assert np.mean(np.abs(between) < 1e-9) > 0.4  # straight lines between detector pixels


def test_the_camera_drifts_steadily_between_corrections() -> None:
    drift = Drift(ramp_c=0.5)
    seconds, offsets_c = drift.series(100, np.random.default_rng(0))
    within = np.diff(seconds // drift.shutter_s) == 0
    slopes = np.diff(offsets_c) / np.diff(seconds)
    np.testing.assert_allclose(np.abs(slopes[within]), 1.0 / drift.shutter_s, rtol=1e-9)
    assert np.abs(offsets_c).max() <= 0.5


def test_each_correction_leaves_an_error() -> None:
    drift = Drift(jump_c=0.3)
    seconds, offsets_c = drift.series(1000, np.random.default_rng(0))
    jumped = np.diff(seconds // drift.shutter_s) > 0
    assert (np.diff(offsets_c)[~jumped] == 0.0).all()
    assert np.diff(offsets_c)[jumped].std() == pytest.approx(0.3 * np.sqrt(2.0), rel=0.2)


def test_after_a_pause_the_camera_is_colder_and_climbs_back() -> None:
    drift = Drift(pauses=1, rest_c=-5.0)
    seconds, offsets_c = drift.series(60, np.random.default_rng(0))
    (pause,) = np.flatnonzero(np.diff(seconds) > drift.pause_s)
    assert offsets_c[[0, pause + 1]] == pytest.approx(-5.0)
    assert offsets_c.min() == pytest.approx(-5.0)
    climbing = np.delete(np.diff(offsets_c), pause)
    assert climbing.min() > 0.0
    assert np.interp(drift.settle_s, seconds - seconds[0], offsets_c) == pytest.approx(
        -5.0 / np.e, abs=0.3
    )


@pytest.mark.parametrize("camera", list(CAMERAS))
def test_a_named_camera_drifts_by_degrees_and_has_every_part(camera: str) -> None:
    imager = CAMERAS[camera]
    _, offsets_c = imager.drift.series(48, np.random.default_rng(0))
    assert 2.0 < np.ptp(offsets_c) < 6.5
    parts = ("aperture_mm", "netd_c", "pattern_c", "column_c", "shading_c", "defective", "missed",
             "sharpening", "exposure_ev")  # fmt: skip
    assert all(getattr(imager, part) > 0.0 for part in parts)


def test_an_unknown_camera_is_refused_with_those_that_there_are() -> None:
    assert named_imager("gaussian") is None
    with pytest.raises(ConfigError, match="wiris-like"):
        named_imager("polaroid")  # type: ignore[arg-type]
