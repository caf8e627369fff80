"""How long a single command takes: which parts count, and how far they are."""

from __future__ import annotations

import pytest

from mrgs.pipeline.expect import left_in_stage
from mrgs.pipeline.forecast import Forecast


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_steps_of_the_thermal_camera_count_on():
    clock = Clock()
    forecast = Forecast({"images": 10.0, "thermal camera": 100.0}, clock)
    assert left_in_stage(forecast, "images: reading and writing", 0, 4) == pytest.approx(110.0)
    clock.now = 10.0
    left = [
        left_in_stage(forecast, f"thermal camera: {step}", done, 600)
        for step, done in [("reading pairs", 0), ("reading pairs", 300), ("matching", 300)]
    ]
    assert left[0] > left[1] > left[2] > 0


def test_slow_photos_leave_more_time_than_was_expected():
    clock = Clock()
    forecast = Forecast({"thermal camera": 100.0}, clock)
    left_in_stage(forecast, "thermal camera: reading pairs", 0, 600)
    clock.now = 400.0  # four times as long as expected for all of it
    left = left_in_stage(forecast, "thermal camera: reading pairs", 300, 600)
    assert left is not None
    assert left > 800
