from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from mrgs.data import load_scene
from mrgs.method.config import make_config
from mrgs.pipeline.forecast import (
    MARGIN,
    PILOT_STEPS,
    Pace,
    measure_pace,
    step_seconds,
    steps_within,
)
from mrgs.runs.registry import Method, find_method
from mrgs.scene import RGB, PosedImage, View
from mrgs.training.start import TrainOptions

CPU = TrainOptions(device="cpu")


def test_a_training_that_does_not_grow_takes_its_pace():
    pace = Pace(loading_s=4.0, step_s=0.1, gaussians=1000, kpx=10.0, mean_kpx=10.0)
    assert steps_within(64.0, pace, 1000) == int(60 / (MARGIN * 0.1))
    assert steps_within(64.0, pace._replace(gaussians=None), None) == int(60 / (MARGIN * 0.1))


def test_growth_leaves_time_for_fewer_steps():
    pace = Pace(
        loading_s=0.0,
        step_s=step_seconds(10_000, 100.0),
        gaussians=10_000,
        kpx=100.0,
        mean_kpx=100.0,
    )
    steps = steps_within(60.0, pace, 50_000)
    at_the_cap = 60.0 / (MARGIN * step_seconds(50_000, 100.0))
    assert at_the_cap < steps < 1.15 * at_the_cap


@pytest.mark.parametrize("seconds", [-5.0, 1.0])
def test_without_time_there_is_one_step(seconds):
    assert steps_within(seconds, Pace(4.0, 0.1, 1000, 10.0, 10.0), 1000) == 1


def test_a_pilot_trains_until_its_pace_is_known_and_leaves_nothing(small_scene):
    seen = {}
    clock = iter(range(1000))

    def train(scene, output, config, options, hooks):
        on_start, on_step = hooks.on_start, hooks.on_step
        seen["output"] = output
        output.mkdir()
        on_start(load_scene(scene), config)
        for step in range(1, 1000):
            if on_step(SimpleNamespace(step=step, gaussians=7)):
                seen["steps"] = step
                return

    method = Method("paced", "", lambda **_: None, train=train)
    pace = measure_pace(method, small_scene, None, CPU, lambda: next(clock))
    assert seen["steps"] == PILOT_STEPS
    kpx = 2 * 40 * 30 / 1e3
    assert pace == Pace(loading_s=1, step_s=1, gaussians=7, kpx=kpx, mean_kpx=kpx)
    assert not seen["output"].exists()


def test_coarse_photos_leave_time_for_more_steps():
    pace = Pace(0.0, step_seconds(1000, 600.0), gaussians=1000, kpx=600.0, mean_kpx=300.0)
    steps = steps_within(60.0, pace, 1000)
    assert steps == int(60.0 / (MARGIN * step_seconds(1000, 300.0)))


def test_a_pilot_trains_on_photos_of_full_resolution(small_scene):
    seen = {}

    def train(scene, output, config, options, hooks):
        on_start, on_step = hooks.on_start, hooks.on_step
        seen["coarse_until"] = config.coarse_until
        loaded = load_scene(scene)
        (camera, *_) = loaded.train[0].cameras.values()
        photo = PosedImage(camera.resized(640, 480), lambda: pytest.fail("no photo is read"))
        on_start(replace(loaded, train=(View("large", {RGB: photo}),)), config)
        for _ in range(3):
            on_step(SimpleNamespace(gaussians=7))

    config = make_config("mrgs", preset="fast", max_steps=100)
    pace = measure_pace(Method("paced", "", lambda **_: None, train=train), small_scene, config)
    assert seen["coarse_until"] == 0
    # Half of the pixels in each direction until step 49 of 100; a quarter would be too few.
    assert pace.mean_kpx == pytest.approx(pace.kpx * (0.49 / 4 + 0.51))


def test_a_pilot_of_a_short_training_ends_with_it(small_scene):
    method = find_method("mrgs-plus")
    config = method.configure("fast", max_steps=2, max_gaussians=50)
    pace = measure_pace(method, small_scene, config, CPU)
    assert pace.step_s > 0
    assert pace.gaussians == 25
