from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.scene import TemperatureRange
from mrgs.scene.radiometry import COLDEST_K, ZERO_CELSIUS_K, BandRadiance, Planck
from mrgs_synth.planck import band_radiance, temperature

SCALE = TemperatureRange(-40.0, 120.0)
CAMERA = Planck(r1=17_000.0, r2=0.0125, b=1_430.0, f=1.0, o=-5_000.0)


def mean_celsius(radiance: BandRadiance, *celsius: float) -> float:
    """What a pixel reads that sees as much of each temperature."""
    values = SCALE.from_celsius(torch.tensor(celsius, dtype=torch.float64))
    return SCALE.to_celsius(radiance.to_value(radiance.of_value(values).mean())).item()


@pytest.mark.parametrize(
    ("cold", "hot", "within"), [(20, 80, 0.3), (-40, 10, 0.2), (0, 20, 0.03), (-40, 80, 0.8)]
)
def test_a_pixel_reads_what_the_band_from_7_5_to_13_um_gives(cold, hot, within):
    exact = temperature(band_radiance(np.array([cold, hot], float)).mean())
    found = mean_celsius(BandRadiance.of(SCALE), cold, hot)
    assert found == pytest.approx(exact, abs=within)
    assert abs(found - (cold + hot) / 2) > 0.5


def test_the_camera_s_own_law_is_used():
    exact = CAMERA.celsius(CAMERA.signals(np.array([20.0, 80.0])).mean())
    assert mean_celsius(BandRadiance.of(SCALE, CAMERA), 20, 80) == pytest.approx(exact, abs=1e-6)


@given(st.floats(-60, 150), st.floats(1, 1000), st.floats(-0.5, 2.0))
def test_values_come_back(low, span, value):
    scale = TemperatureRange(low, low + span)
    value = max(value, scale.from_celsius(-120.0))
    radiance = BandRadiance.of(scale)
    there = radiance.of_value(torch.tensor([0.0, 1.0, value]))
    torch.testing.assert_close(there[:2], torch.tensor([0.0, 1.0]), atol=2e-3, rtol=0)
    back = radiance.to_value(there)
    # Cold radiances are small beside the range's: float32 keeps them to 1e-7 of it.
    assert (scale.span_c * (back[2] - value)).abs() < 0.3


def test_gradients():
    radiance = BandRadiance.of(SCALE)
    values = torch.linspace(-0.3, 1.5, 7, dtype=torch.float64, requires_grad=True)
    received = radiance.of_value(values).detach().requires_grad_()
    assert torch.autograd.gradcheck(radiance.of_value, values)
    assert torch.autograd.gradcheck(radiance.to_value, received)


def test_what_is_colder_than_cameras_see_is_finite_and_comes_back():
    radiance = BandRadiance.of(SCALE)
    absurd = torch.tensor([-50.0, -1e6], requires_grad=True)
    back = radiance.to_value(radiance.of_value(absurd))
    coldest = SCALE.from_celsius(COLDEST_K - ZERO_CELSIUS_K)
    torch.testing.assert_close(back, torch.full((2,), coldest), atol=2e-3, rtol=0)
    back.sum().backward()
    torch.testing.assert_close(absurd.grad, torch.ones(2), atol=0.01, rtol=0)
    assert radiance.to_value(torch.tensor([-1e9])).isfinite().all()


@pytest.mark.parametrize("scale", [(-273.15, 20.0), (-200.0, -100.0), (-40.0, 3_500.0)])
def test_extreme_scales_keep_their_ends(scale):
    low, high = scale
    radiance = BandRadiance.of(TemperatureRange(low, high))
    ends = radiance.to_value(torch.tensor([0.0, 1.0]))
    coldest = max(0.0, (COLDEST_K - ZERO_CELSIUS_K - low) / (high - low))
    torch.testing.assert_close(ends, torch.tensor([coldest, 1.0]), atol=1e-3, rtol=0)


def test_a_scale_colder_than_cameras_see_has_none():
    assert BandRadiance.of(TemperatureRange(-220.0, -130.0)) is None


@pytest.mark.parametrize("b", [500.0, 1_439.0, 5_000.0, 20_000.0])
def test_cold_values_of_any_camera_have_finite_gradients_and_come_back(b):
    radiance = BandRadiance(low_k=253.15, span_k=120.0, b=b)
    values = torch.tensor([-3.0, -0.5, 0.0, 0.5, 1.0], requires_grad=True)
    back = radiance.to_value(radiance.of_value(values))
    back.sum().backward()
    assert values.grad.isfinite().all()
    torch.testing.assert_close(values.grad, torch.ones(5), atol=0.02, rtol=0)
    torch.testing.assert_close(back[2:], values[2:].detach(), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    "change",
    [{"span_k": 0.0}, {"b": -1.0}, {"b": 1e300}, {"low_k": math.nan}, {"span_k": math.inf}],
)
def test_what_is_no_law_is_refused(change):
    good = {"low_k": 253.15, "span_k": 120.0, "b": 1_439.0}
    with pytest.raises(ValueError, match="thermal camera"):
        BandRadiance(**good | change)
