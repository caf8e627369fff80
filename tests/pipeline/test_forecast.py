"""Time left, from expected lengths and the pace so far."""

from __future__ import annotations

import pytest

from mrgs.pipeline.forecast import Forecast, pace_so_far


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_at_the_start_it_is_what_was_expected(clock):
    forecast = Forecast({"a": 10.0, "b": 30.0}, clock)
    assert forecast.left("a", 0.0) == pytest.approx(40.0)


def test_at_the_expected_pace_it_counts_down(clock):
    forecast = Forecast({"a": 10.0, "b": 30.0}, clock)
    clock.now = 25.0
    assert forecast.left("b", 0.5) == pytest.approx(15.0)
    clock.now = 40.0
    assert forecast.left("b", 1.0) == 0.0


def test_it_follows_the_measured_pace(clock):
    forecast = Forecast({"a": 10.0, "b": 30.0}, clock)
    clock.now = 60.0  # three times as long as expected
    left = forecast.left("b", 1 / 3)
    assert left is not None
    assert 50.0 < left < 60.0


def test_where_progress_is_not_known_time_passes_all_the_same(clock):
    forecast = Forecast({"a": 10.0, "b": 30.0}, clock)
    assert forecast.left("a") == pytest.approx(40.0)
    clock.now = 5.0
    assert forecast.left("a") == pytest.approx(35.0)
    clock.now = 500.0  # it takes much longer; something must still be left
    left = forecast.left("a")
    assert left is not None
    assert left > 30.0


@pytest.mark.parametrize("parts", [{"a": 0.0}, {"a": 0.0, "b": 0.0}])
def test_work_of_no_length_takes_no_time(parts, clock):
    assert Forecast(parts, clock).left("a") == 0.0


def test_of_a_part_that_is_not_known_nothing_is_said(clock):
    assert Forecast({"a": 10.0}, clock).left("b") is None


def test_a_short_stage_that_takes_five_times_as_long_says_little_of_a_long_one():
    assert pace_so_far(5.0, 1.0, 200.0) < 1.25
    assert pace_so_far(500.0, 100.0, 200.0) > 4.0
    assert pace_so_far(0.0, 0.0, 0.0) == 1.0
