from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrgs.data.radiometric.measurement import Measurement
from mrgs.scene.air import Atmosphere
from mrgs.scene.radiometry import ObjectParameters, Planck

PLANCK = Planck(15000.0, 0.0125, 1400.0, 1.0, -6000.0)
AIR = Atmosphere(0.006569, 0.01262, -0.002276, -0.00667, 1.9)


@given(st.floats(-80, 1500))
def test_planck_and_back(celsius):
    back = PLANCK.celsius(np.array([PLANCK.signal(celsius)]))
    assert back[0] == pytest.approx(celsius, abs=1e-6)


@given(st.floats(0.1, 1), st.floats(0, 500), st.floats(-50, 80), st.floats(0, 1), st.floats(0.3, 1))
def test_everything_at_one_temperature_is_measured_as_it_is(
    emissivity, distance, celsius, humidity, window
):
    """In a cavity of one temperature, emissivity, air and window do not matter."""
    parameters = ObjectParameters(emissivity, distance, celsius, celsius, humidity, celsius, window)
    tau = AIR.transmission(distance, celsius, humidity)
    measured = Measurement(PLANCK, parameters, tau).celsius(np.array([PLANCK.signal(celsius)]))
    assert measured[0] == pytest.approx(celsius, abs=1e-5)


@given(st.floats(0, 2000), st.floats(-20, 40), st.floats(0, 1))
def test_air_lets_a_share_pass(distance, air_c, humidity):
    assert 0 < AIR.transmission(distance, air_c, humidity) <= 1


def test_no_air_in_front_of_the_lens():
    assert AIR.transmission(0.0, 20.0, 0.5) == pytest.approx(1, abs=1e-12)


def test_a_published_transmission():
    """The defaults of FLIR cameras (20 °C, 50 %): 0.99 at 1 m, and well under it at 100 m."""
    assert AIR.transmission(1.0, 20.0, 0.5) == pytest.approx(0.9939, abs=1e-4)
    assert 0.8 < AIR.transmission(100.0, 20.0, 0.5) < 0.95


def test_a_surface_that_reflects_a_cold_sky_is_warmer_than_it_looks():
    signal = np.array([PLANCK.signal(10.0)])
    looks = ObjectParameters(1.0, 0.0, -40.0, 20.0, 0.5)
    shiny = ObjectParameters(0.8, 0.0, -40.0, 20.0, 0.5)
    assert Measurement(PLANCK, looks, 1.0).celsius(signal)[0] == pytest.approx(10.0, abs=1e-6)
    assert Measurement(PLANCK, shiny, 1.0).celsius(signal)[0] > 15


def test_less_signal_than_the_surroundings_send_has_no_temperature():
    mirror = ObjectParameters(0.05, 0.0, 60.0, 20.0, 0.5)
    assert np.isnan(Measurement(PLANCK, mirror, 1.0).celsius(np.array([PLANCK.signal(0.0)]))[0])
