from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import TypeAlias

import pytest
import torch

from mrgs.data import load_scene
from mrgs.method.camera_model.point_spread import SMALLEST_LEARNED_PX
from mrgs.method.losses.photometric import LossConfig
from mrgs.method.losses.term import LossContext, SceneScale, Term
from mrgs.render import render
from mrgs.scene import RGB, THERMAL, Modality, Pixels
from mrgs.training.state import initial_state
from mrgs.training.step import (
    StepResult,
    StepStatistics,
    control_density,
    training_step,
)
from mrgs.training.view_pass import PhotographedView
from tests.helpers.full_memory import FullAt
from tests.helpers.training import short_config, tensors_of

Photos: TypeAlias = dict[Modality, Pixels]


def photos_of(view) -> Photos:
    return {each: image.load() for each, image in view.images.items()}


def take(state, scene, config, number: int = 0, photos: Photos | None = None) -> StepStatistics:
    """A step, and density control after it."""
    result = do_step(state, scene, config, number, photos)
    control_density(state, result, config, scene.extent)
    return result.statistics


def do_step(state, scene, config, number: int = 0, photos: Photos | None = None) -> StepResult:
    view = scene.train[number]
    return training_step(
        state,
        [PhotographedView(number, view, photos or photos_of(view))],
        config,
        SceneScale(scene.extent, scene.temperature),
    )


@pytest.mark.parametrize("method", ["mrgs", "3dgs-rgbt"])
def test_a_step_moves_every_parameter_that_the_method_has(method, make_start):
    config = short_config(method, sh_every=1)
    scene, state = make_start(config)
    before = tensors_of(state)
    for number in range(3):
        statistics = take(state, scene, config, number)
        assert (statistics.step, statistics.gaussians, statistics.skipped) == (
            number + 1,
            25,
            False,
        )
    assert state.step == 3
    after = tensors_of(state)
    frame = ("field.center", "field.scale")
    for name, tensor in before.items():
        if tensor.numel() > 0 and not name.startswith(frame):
            assert not torch.equal(after[name], tensor), name


def test_a_step_moves_the_point_spread_to_no_width_that_has_no_gradient(make_start):
    config = short_config("mrgs-plus")
    _, state = make_start(config)
    spread = state.image_model.point_spread
    spread.log_sigma.data.fill_(math.log(SMALLEST_LEARNED_PX))
    spread.log_sigma.grad = torch.ones(())
    state.move(config, torch.tensor(True))
    assert spread.sigma_px.item() == pytest.approx(SMALLEST_LEARNED_PX)


def test_the_loss_is_the_weighted_sum_of_its_terms(make_start):
    config = short_config()
    scene, state = make_start(config)
    statistics = take(state, scene, config)
    terms = statistics.terms
    weighted = terms["rgb"] + terms["thermal"] + 0.6 * terms["smooth"] + 0.05 * terms["boltzmann"]
    assert statistics.loss == pytest.approx(weighted, rel=1e-5)


def test_several_views_count_as_their_mean(make_start):
    """Twice the same view: the same gradients and numbers, but two observations."""
    taken = []
    for batch in (1, 2):
        config = short_config(batch=batch)
        scene, state = make_start(config)
        view = PhotographedView(0, scene.train[0], photos_of(scene.train[0]))
        scale = SceneScale(scene.extent, scene.temperature)
        result = training_step(state, [view] * batch, config, scale)
        taken.append((tensors_of(state), result))
    (one, first), (two, second) = taken
    for name, tensor in one.items():
        torch.testing.assert_close(two[name], tensor, rtol=1e-4, atol=1e-7, msg=name)
    assert second.statistics.loss == pytest.approx(first.statistics.loss)
    assert second.statistics.terms == pytest.approx(first.statistics.terms)
    assert second.statistics.thermal_error == pytest.approx(first.statistics.thermal_error)
    for name, value in first.observed.items():
        torch.testing.assert_close(second.observed[name], 2 * value, msg=name)


class Offset(Term):
    """Has a parameter of its own."""

    name = "offset"
    learning_rate = 0.25

    def __init__(self) -> None:
        self.learned = torch.nn.Linear(1, 1)

    def value(self, context: LossContext) -> torch.Tensor:
        return self.learned.weight.sum() - self.learned.bias.sum()


def test_a_term_learns_at_its_own_rate(small_scene):
    """Adam's first step is as long as the rate."""
    config, scene = short_config(), load_scene(small_scene)
    term = Offset()
    before = [each.detach().clone() for each in term.learned.parameters()]
    state = initial_state(scene, config, terms=[term])
    do_step(state, scene, config)
    weight, bias = (
        (now - old).item() for now, old in zip(term.learned.parameters(), before, strict=True)
    )
    assert (weight, bias) == pytest.approx((-0.25, 0.25), rel=1e-3)


def test_the_thermal_error_is_that_of_the_valid_pixels(make_start):
    config = short_config("3dgs-rgbt")
    scene, state = make_start(config)
    whole = photos_of(scene.train[0])
    valid = torch.zeros(30, 40, dtype=torch.bool)
    valid[5:20, 10:20] = True
    expected = _thermal_error_of(state, scene, whole[THERMAL].values, valid)
    photos = whole | {THERMAL: Pixels(whole[THERMAL].values, valid)}
    assert take(state, scene, config, photos=photos).thermal_error == pytest.approx(
        expected, rel=1e-5
    )


def _thermal_error_of(state, scene, photo: torch.Tensor, valid: torch.Tensor) -> float:
    with torch.no_grad():
        rendering, _ = render(state.model, scene.train[0].cameras)
        seen = state.image_model(rendering, torch.tensor([0]))[THERMAL].image
    return float((seen - photo).abs()[valid].mean())


class Poison(Term):
    """A loss that is NaN, or whose gradient is, from when it is let out."""

    name = "poison"
    is_out = False

    def __init__(self, in_loss: bool) -> None:
        self._in_loss = in_loss

    def value(self, context: LossContext) -> torch.Tensor | None:
        if not self.is_out:
            return None
        nothing = (0 * context.gaussians.means).sum()
        return nothing * float("nan") if self._in_loss else nothing.sqrt()  # 0 · d√x at 0


def with_nan(photos: Photos) -> Photos:
    """One pixel that is NaN."""
    values = photos[THERMAL].values.clone()
    values[7, 9] = float("nan")
    return photos | {THERMAL: Pixels(values)}


@pytest.mark.parametrize("poisoned", ["loss", "gradient", "photo"])
def test_a_step_that_is_not_finite_changes_nothing(poisoned, make_start):
    config, poison = short_config(), Poison(in_loss=poisoned == "loss")
    scene, state = make_start(config, terms=[poison])
    for number in range(2):
        take(state, scene, config, number)
    before = tensors_of(state)
    photos = photos_of(scene.train[2])
    poison.is_out = poisoned != "photo"
    for in_a_row in (1, 2):
        photos = with_nan(photos) if poisoned == "photo" else photos
        statistics = take(state, scene, config, 2, photos)
        assert statistics.skipped
        assert math.isfinite(statistics.loss) == (poisoned == "gradient")
        assert state.skipped_in_a_row == in_a_row
    after = tensors_of(state)
    assert set(after) == set(before)
    assert [name for name in before if not torch.equal(after[name], before[name])] == []
    assert (state.step, state.skipped_in_a_row) == (4, 2)

    poison.is_out = False
    assert not take(state, scene, config, 3).skipped
    assert state.skipped_in_a_row == 0
    assert all(tensor.isfinite().all() for tensor in tensors_of(state).values())


def test_ignored_pixels_do_not_matter(make_start):
    """Whatever stands in them, the same parameters come out, but for SSIM's windows that reach into
    them."""
    config = short_config(loss=LossConfig(dssim=0.0))

    def after(value: float) -> dict[str, torch.Tensor]:
        scene, state = make_start(config)
        photos = photos_of(scene.train[0])
        valid = torch.ones(30, 40, dtype=torch.bool)
        valid[5:20, 10:20] = False
        hidden = {
            each: Pixels(torch.where(valid[..., None], photo.values, torch.tensor(value)), valid)
            for each, photo in photos.items()
        }
        statistics = take(state, scene, config, photos=hidden)
        assert not statistics.skipped
        return {**tensors_of(state), "error": torch.tensor(statistics.thermal_error)}

    first, second = after(0.1), after(0.9)
    assert [name for name in first if not torch.equal(first[name], second[name])] == []


def test_the_harmonics_follow_the_schedule(make_start):
    config = short_config(sh_every=2)
    scene, state = make_start(config)
    degrees = []
    for number in range(6):
        take(state, scene, config, number)
        degrees.append(state.model.sh_degree)
    assert degrees == [0, 1, 1, 2, 2, 3]


@pytest.mark.parametrize("method", ["mrgs", "3dgs-rgbt"])
def test_harmonics_of_the_temperature_that_were_asked_for_are_used_at_every_step(
    method, make_start
):
    config = short_config(method, sh_every=1, temperature_sh_degree=3)
    scene, state = make_start(config)
    moment = "adam.sh_rest.thermal.exp_avg_sq"
    for number in range(3):
        before = state.gaussian_optimizer.state().get(moment, torch.zeros(1)).clone()
        take(state, scene, config, number)
        assert (state.gaussian_optimizer.state()[moment] > before).any()


def test_harmonics_for_photos_without_celsius_rest_at_every_second_step():
    config = replace(short_config("mrgs-plus", sh_every=1), max_steps=6)
    assert [config.temperature_sh_degree_at(step) for step in range(1, 7)] == [1, 0, 3, 0, 3, 0]


def test_the_neighbours_stay_the_same_at_the_end(make_start):
    config = short_config(max_steps=6, neighbours_every=3)
    scene, state = make_start(config)
    seen = []
    for number in range(6):
        do_step(state, scene, config, number)
        seen.append(state.model.neighbours)
    assert seen[2] is not seen[1]
    assert seen[5] is seen[2]


def test_harmonics_that_are_not_in_use_do_not_move(make_start):
    config = short_config("mrgs", sh_every=3)
    scene, state = make_start(config)
    for number in range(3):
        rest = state.model.gaussians.sh_rest[RGB]
        assert (rest == 0).all()
        take(state, scene, config, number)
    rest = state.model.gaussians.sh_rest[RGB]  # step 3 is the first with degree 1
    assert (rest[:, :3] != 0).any()
    assert (rest[:, 3:] == 0).all()


def test_neighbours_are_searched_again_on_schedule_and_when_rows_change(make_start):
    config = short_config(neighbours_every=3)
    schedule = replace(config.densification, start=0, every=4, stop=100, gradient_threshold=0.0)
    config = replace(config, densification=schedule)
    scene, state = make_start(config)
    assert state.model.neighbours is None
    seen = []
    for number in range(5):
        result = do_step(state, scene, config, number)
        seen.append(state.model.neighbours)
        control_density(state, result, config, scene.extent)
    assert seen[0] is seen[1]
    assert seen[2] is not seen[1]
    assert seen[3] is seen[2]
    assert [len(neighbours) for neighbours in seen] == [25, 25, 25, 25, 50]


@pytest.mark.parametrize("distant_points", [False, True])
def test_large_gaussians_are_pruned_after_the_first_reset_but_for_a_sky(distant_points, make_start):
    config = short_config(distant_points=distant_points)
    schedule = replace(
        config.densification, start=0, stop=9, every=4, reset_every=2, gradient_threshold=1e9
    )
    config = replace(config, densification=schedule)
    scene, state = make_start(config)
    with torch.no_grad():
        state.model.gaussians.log_scales[:] = math.log(0.5 * schedule.prune_above * scene.extent)
        state.model.gaussians.log_scales[:3] = math.log(2 * schedule.prune_above * scene.extent)
    count, state.step = len(state.model.gaussians), 4
    statistics = StepStatistics(4, 0.0, {}, None, count, skipped=False)
    done = StepResult(statistics, dict(state.strategy_state), torch.tensor(True))
    control_density(state, done, config, scene.extent)
    assert count - len(state.model.gaussians) == (0 if distant_points else 3)


def test_density_control_starts_the_statistics_anew_and_resets_opacities(make_start):
    config = short_config()
    schedule = replace(
        config.densification, start=0, every=2, stop=4, reset_every=3, gradient_threshold=0.0
    )
    config = replace(config, densification=schedule)
    scene, state = make_start(config)
    result = do_step(state, scene, config, 0)
    assert control_density(state, result, config, scene.extent) is None
    assert state.strategy_state["views"].sum() > 0
    result = do_step(state, scene, config, 1)
    counts = control_density(state, result, config, scene.extent)
    assert counts["cloned"] + counts["split"] == 25
    assert state.strategy_state["views"].tolist() == [0.0] * 50
    assert state.gaussian_optimizer.gaussians is state.model.gaussians
    assert state.model.gaussians.opacity(RGB).max() > 0.05
    result = do_step(state, scene, config, 2)
    control_density(state, result, config, scene.extent)
    assert state.model.gaussians.opacity(RGB).max() <= 0.01 + 1e-6
    assert state.model.gaussians.opacity(THERMAL).max() <= 0.01 + 1e-6


def test_density_control_learns_nothing_of_a_step_that_is_not_finite(make_start):
    config = short_config()
    schedule = replace(
        config.densification, start=0, every=2, stop=9, reset_every=2, gradient_threshold=0.0
    )
    config = replace(config, densification=schedule)
    scene, state = make_start(config)
    control_density(state, do_step(state, scene, config, 0), config, scene.extent)
    before = {name: tensor.clone() for name, tensor in state.strategy_state.items()}
    poisoned = do_step(state, scene, config, 1, with_nan(photos_of(scene.train[1])))
    assert control_density(state, poisoned, config, scene.extent) is None
    assert all(torch.equal(state.strategy_state[name], before[name]) for name in before)
    assert len(state.model.gaussians) == 25
    assert state.model.gaussians.opacity(RGB).max() > 0.05


def test_wherever_memory_runs_out_in_density_control_nothing_has_changed(make_start):
    config = short_config()
    schedule = replace(config.densification, start=0, every=2, stop=4, gradient_threshold=0.0)
    config = replace(config, densification=replace(schedule, reset_every=2))
    scene, state = make_start(config)
    control_density(state, do_step(state, scene, config, 0), config, scene.extent)
    result = do_step(state, scene, config, 1)
    before, generator = tensors_of(state), state.generator.get_state()
    tensors = 0
    while len(state.model.gaussians) == 25:
        now = tensors_of(state)
        assert now.keys() == before.keys()
        assert all(torch.equal(now[name], before[name]) for name in before)
        state.generator.set_state(generator)
        with suppress(torch.cuda.OutOfMemoryError), FullAt(tensors):
            control_density(state, result, config, scene.extent)
        tensors += 1
    assert tensors > 50
    assert len(state.model.gaussians) == 50
    assert state.model.gaussians.opacity(RGB).max() <= 0.01 + 1e-6
