from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrgs.scene import TemperatureRange
from mrgs_synth.radiometry import pixel_readings
from mrgs_synth.sensor import NETD_AT_C, ThermalSensor, quantise, rounded_range

NOISELESS = ThermalSensor(netd_c=0.0, column_noise_c=0.0)


def test_pixels_average_radiance() -> None:
    """A chequer of 20 and 80 °C reads 53.7 °C, as a black body between 7.5 and 13 µm does."""
    chequer = np.where(np.indices((48, 64)).sum(axis=0) % 2, 20.0, 80.0)
    inside = NOISELESS.photograph(chequer, 0, 0)[8:-8, 8:-8]
    np.testing.assert_allclose(inside, 53.70, atol=0.01)
    np.testing.assert_allclose(pixel_readings(chequer, 2), 53.70, atol=0.01)


def test_uniform_stays_uniform() -> None:
    np.testing.assert_allclose(NOISELESS.photograph(np.full((16, 32), 21.5), 0, 0), 21.5)


@pytest.mark.parametrize("spread", [1.0, 1.2, 2.0])
def test_point_spread(spread: float) -> None:
    """The variance of a point's image, averaged over the four positions of a point on a detector
    pixel."""
    sensor = ThermalSensor(point_spread_px=spread, netd_c=0.0, column_noise_c=0.0)
    coordinate = np.arange(64)
    variances = []
    for row in (30, 31):
        exact = np.zeros((64, 64))
        exact[row, 30 + row % 2] = 1.0
        image = sensor.photograph(exact, 0, 0)
        variances += [(image.sum(axis=1) * (coordinate - row) ** 2).sum()]
    assert np.sqrt(np.mean(variances)) == pytest.approx(spread, abs=0.02)


def test_noise_has_the_stated_strength() -> None:
    sensor = ThermalSensor(netd_c=0.2, column_noise_c=0.0)
    image = sensor.photograph(np.full((240, 320), NETD_AT_C), 3, 0)
    # Interpolation to twice the size keeps (0.75² + 0.25²)² of the variance.
    assert image.std() == pytest.approx(0.2 * 0.625, rel=0.03)
    assert image.mean() == pytest.approx(NETD_AT_C, abs=0.01)
    cold = sensor.photograph(np.full((240, 320), -10.0), 3, 0)
    assert cold.std() > 1.5 * image.std()


def test_columns_are_fixed_and_noise_is_not() -> None:
    sensor = ThermalSensor(netd_c=0.1, column_noise_c=0.5)
    flat = np.full((240, 320), 20.0)
    first, second = sensor.photograph(flat, 0, 7), sensor.photograph(flat, 1, 7)
    assert not np.array_equal(first, second)
    assert np.corrcoef(first.mean(axis=0), second.mean(axis=0))[0, 1] > 0.99
    other = ThermalSensor(netd_c=0.1, column_noise_c=0.5).photograph(flat, 0, 8)
    assert abs(np.corrcoef(first.mean(axis=0), other.mean(axis=0))[0, 1]) < 0.5
    np.testing.assert_array_equal(first, sensor.photograph(flat, 0, 7))


def test_quantise_rounds_to_half_a_step_and_clips() -> None:
    temperature = TemperatureRange(10.0, 61.0)
    celsius = np.linspace(10.0, 61.0, 1000)[None]
    grey = quantise(celsius, temperature)
    assert grey.dtype == np.uint8
    assert np.abs(temperature.to_celsius(grey / 255.0) - celsius).max() <= 0.5 * 51.0 / 255.0 + 1e-9
    np.testing.assert_array_equal(quantise(np.array([[-40.0, 400.0]]), temperature), [[0, 255]])


@given(st.floats(-50.0, 200.0), st.floats(0.0, 200.0))
def test_range_holds_both_ends_in_whole_degrees(coldest: float, span: float) -> None:
    temperature = rounded_range(coldest, coldest + span)
    assert coldest - 1.5 <= temperature.min_c <= coldest - 0.5
    assert coldest + span + 0.5 <= temperature.max_c <= coldest + span + 1.5
    assert temperature.min_c.is_integer()
    assert temperature.max_c.is_integer()
