from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrgs.pictures.drawing import Scale
from mrgs.pictures.palette import (
    INVALID_COLOR,
    PALETTES,
    PaletteName,
    display_range,
    palette_table,
    round_ticks,
    tick_labels,
)


def lightness(table: np.ndarray) -> np.ndarray:
    """CIE L* of sRGB bytes."""
    encoded = table / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    luminance = linear @ np.array([0.2126, 0.7152, 0.0722])
    return np.where(luminance > 0.008856, 116 * np.cbrt(luminance) - 16, 903.3 * luminance)


@pytest.mark.parametrize("name", ["inferno", "iron", "grey", "depth"])
def test_sequential_palettes_rise_in_lightness(name: PaletteName) -> None:
    rise = np.diff(lightness(palette_table(name)))
    assert rise.min() > -0.25  # bytes round
    assert lightness(palette_table(name))[-1] - lightness(palette_table(name))[0] > 75


def test_inferno_rises_evenly() -> None:
    steps = np.diff(lightness(palette_table("inferno"))[::15])
    assert steps.max() < 1.6 * steps.mean()


def test_the_error_palette_is_white_in_the_middle_and_dark_at_both_ends() -> None:
    values = lightness(palette_table("error"))
    assert values.argmax() in range(126, 130)
    assert np.diff(values[:126]).min() > -0.25
    assert np.diff(values[130:]).max() < 0.25
    assert palette_table("error")[0][2] > palette_table("error")[0][0]  # cold is blue
    assert palette_table("error")[-1][0] > palette_table("error")[-1][2]  # warm is red


@pytest.mark.parametrize("name", PALETTES)
def test_the_limits_take_the_first_and_the_last_color(name: PaletteName) -> None:
    values = np.array([[-40.0, 20.0, 30.0, 99.0]])
    image = Scale(name, 20.0, 30.0, "").colorize(values)
    table = palette_table(name)
    np.testing.assert_array_equal(image[0], [table[0], table[0], table[-1], table[-1]])


def test_endpoints_by_value() -> None:
    assert palette_table("grey")[[0, 128, 255]].tolist() == [
        [0, 0, 0],
        [128, 128, 128],
        [255, 255, 255],
    ]
    assert palette_table("inferno")[[0, 255]].tolist() == [[0, 0, 4], [252, 255, 164]]
    assert palette_table("iron")[[0, 255]].tolist() == [[0, 0, 5], [255, 255, 255]]


def test_a_reversed_scale_runs_the_other_way() -> None:
    values = np.linspace(0, 1, 11)[None]
    usual = Scale("grey", 0.0, 1.0, "").colorize(1 - values)
    np.testing.assert_array_equal(Scale("grey", 1.0, 0.0, "").colorize(values), usual)


def test_nan_turns_grey() -> None:
    image = Scale("iron", 0.0, 1.0, "").colorize(np.array([[np.nan]]))
    assert image[0, 0].tolist() == list(INVALID_COLOR)


def test_ticks_by_hand() -> None:
    assert round_ticks(8.0, 41.0, 5) == [10.0, 20.0, 30.0, 40.0]
    assert round_ticks(-0.2, 0.2, 4) == [-0.2, -0.1, 0.0, 0.1, 0.2]
    assert round_ticks(5.0, 3.0, 2) == [3.0, 4.0, 5.0]
    assert tick_labels([-0.5, 0.0, 0.5]) == ["−0.5", "0.0", "0.5"]
    assert tick_labels([10.0, 20.0]) == ["10", "20"]
    assert tick_labels([0.025, 0.05]) == ["0.025", "0.050"]
    assert tick_labels([-0.5, 1.0], ",") == ["−0,5", "1,0"]


@given(st.floats(-500, 3000), st.floats(0.01, 3000), st.integers(2, 12))
def test_ticks_lie_inside_and_are_evenly_spaced(low: float, span: float, count: int) -> None:
    ticks = round_ticks(low, low + span, count)
    assert 1 <= len(ticks) <= count + 1 or (count == 2 and len(ticks) >= 0)
    assert all(
        low - 1e-6 * span - 1e-9 <= tick <= low + span + 1e-6 * span + 1e-9 for tick in ticks
    )
    steps = np.diff(ticks)
    assert all(math.isclose(step, steps[0], rel_tol=1e-6) for step in steps)
    assert [float(label.replace("−", "-")) for label in tick_labels(ticks)] == pytest.approx(
        ticks, abs=1e-6
    )


def test_display_range_is_never_empty() -> None:
    assert display_range(np.array([np.nan, np.inf])) == (0.0, 1.0)
    assert display_range(np.full(5, 20.0)) == (19.5, 20.5)
    low, high = display_range(np.append(np.linspace(0, 1, 1001), 1000.0), tail=1.0)
    assert 0 < low < 0.05
    assert 0.95 < high <= 1
