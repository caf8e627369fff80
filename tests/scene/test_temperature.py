from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.scene import TemperatureRange

RANGES = st.tuples(st.floats(-273, 2_000), st.floats(0.1, 2_000)).map(
    lambda pair: TemperatureRange(pair[0], pair[0] + pair[1])
)


@given(RANGES, st.floats(-2, 3))
def test_celsius_and_back(temperature, value):
    celsius = temperature.to_celsius(value)
    assert temperature.from_celsius(celsius) == pytest.approx(value, abs=1e-9)
    assert temperature.to_kelvin(value) == pytest.approx(celsius + 273.15)


@given(RANGES)
def test_ends_are_the_bounds(temperature):
    assert temperature.to_celsius(0.0) == temperature.min_c
    assert temperature.to_celsius(1.0) == pytest.approx(temperature.max_c)
    assert temperature.span_c == pytest.approx(temperature.max_c - temperature.min_c)


@pytest.mark.parametrize(
    ("low", "high", "whole"),
    [
        (-3.2, 20.1, (-4.0, 21.0)),
        (5.0, 7.0, (5.0, 7.0)),
        (5.0, 5.0, (5.0, 6.0)),
        (5.2, 5.3, (5.0, 6.0)),
    ],
)
def test_a_range_around_temperatures_has_whole_degrees(low, high, whole):
    assert TemperatureRange.around(low, high) == TemperatureRange(*whole)


@pytest.mark.parametrize("make", [torch.tensor, np.array])
def test_whole_images_are_converted(make):
    temperature = TemperatureRange(10.0, 30.0)
    image = make([[0.0, 0.5], [1.0, -0.5]])
    assert temperature.to_celsius(image).tolist() == [[10.0, 20.0], [30.0, 0.0]]
    assert temperature.from_celsius(temperature.to_celsius(image)).tolist() == image.tolist()


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (20.0, 20.0),
        (30.0, 10.0),
        (-300.0, 10.0),
        (float("nan"), 1.0),
        (0.0, float("nan")),
        (0.0, float("inf")),
    ],
)
def test_what_is_no_range_is_refused(low, high):
    with pytest.raises(ValueError, match="temperature range"):
        TemperatureRange(low, high)
