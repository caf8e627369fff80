"""NaN and infinity put into a training that runs: nothing of it is ever saved."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from torch import Tensor

from mrgs.errors import NotFiniteError, TrainingError
from mrgs.run_files.folder import RunFolder
from mrgs.training import loop, train
from mrgs.training.checkpoint import tensors_of
from mrgs.training.start import TrainOptions
from mrgs_thermonerf import run as nerf_run
from mrgs_thermonerf import train_thermonerf
from mrgs_thermonerf.run import tensors_of as nerf_tensors
from tests.faults.injections import not_finite, put
from tests.faults.runs import GAUSSIANS, NERF

AT = 9
"""The step before which a value is put in; there are checkpoints at 5 and 10, and the last
densification at 8."""


def inject(
    monkeypatch: pytest.MonkeyPatch, module, where: Callable[..., dict[str, Tensor]], *what
) -> None:
    """Put a value into a tensor of the state at one step."""
    name, value, everywhere = what

    def before(state, *rest):
        if state.step == AT - 1:
            put(where(state, *rest)[name], value, everywhere)

    around_steps(monkeypatch, module, before)


def around_steps(monkeypatch: pytest.MonkeyPatch, module, before: Callable[..., object]) -> None:
    """Do something to the state before each step; what it returns is called after the step."""
    original = module.training_step

    def training_step(state, *rest):
        after = before(state, *rest)
        result = original(state, *rest)
        if after is not None:
            after()
        return result

    monkeypatch.setattr(module, "training_step", training_step)


@pytest.fixture
def at_5(gaussians_run: RunFolder) -> RunFolder:
    """The run of Gaussians as it was after step 5; to fit a model again would take a second."""
    gaussians_run.newest_checkpoint().unlink()
    assert saved(gaussians_run) == [5]
    return gaussians_run


@pytest.fixture
def nerf_at_5(nerf_run: RunFolder) -> RunFolder:
    """The run of a radiance field as it was after step 5."""
    nerf_run.newest_checkpoint().unlink()
    assert saved(nerf_run) == [5]
    return nerf_run


def go_on(scene: Path, run: RunFolder) -> None:
    """Train to step 10."""
    train(scene, run.path, GAUSSIANS, options=TrainOptions(resume=True))


def saved(run: RunFolder) -> list[int]:
    """Steps of the checkpoints, all of whose tensors are finite."""
    paths = run.checkpoints()
    for path in paths:
        assert not_finite(path) == []
    return [int(path.stem.removeprefix("step_")) for path in paths]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gaussians.means", math.nan),
        ("gaussians.log_scales", math.inf),
        ("gaussians.sh_dc.thermal", math.inf),
        ("gaussians.adam.quats.exp_avg", math.nan),
        ("gaussians.adam.opacity_logit.rgb.exp_avg_sq", math.inf),
        ("field.color_head.mlp.2.weight", math.nan),
        ("field.scale", math.inf),
        ("layer_optimizer.3.exp_avg_sq", math.nan),
        ("image_model.point_spread.log_sigma", math.nan),
        ("terms.boltzmann.psi.weight", math.inf),
        ("strategy.gradient_sum", math.nan),
    ],
)
def test_gaussians(name, value, small_scene, at_5, monkeypatch):
    where = lambda state, *rest: tensors_of(state)  # noqa: E731
    inject(monkeypatch, loop, where, name, value, name.endswith("weight"))
    with pytest.raises(TrainingError, match="last good") as caught:
        go_on(small_scene, at_5)
    assert str(at_5.checkpoint_file(5)) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert saved(at_5) == [5]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_photos(value, small_scene, at_5, monkeypatch):
    def where(state, views, *rest):
        return {modality.name: pixels.values for modality, pixels in views[0].photos.items()}

    inject(monkeypatch, loop, where, "thermal", value, False)
    go_on(small_scene, at_5)  # the step is skipped, and no other has it
    assert saved(at_5) == [5, 10]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("model.field.grid.table", math.inf),
        ("model.field.color_head.output.bias", math.nan),
        ("model.proposal.geometry.hidden.weight", math.inf),
        ("adam.field.grid.table.exp_avg", math.nan),
        ("adam.field.geometry.output.weight.exp_avg_sq", math.inf),
    ],
)
def test_radiance_fields(name, value, small_scene, nerf_at_5, monkeypatch):
    where = lambda state, *rest: nerf_tensors(state)  # noqa: E731
    inject(monkeypatch, nerf_run, where, name, value, True)
    with pytest.raises(TrainingError, match=r"last good .*step_000005"):
        train_thermonerf(small_scene, nerf_at_5.path, NERF, TrainOptions(resume=True))
    assert saved(nerf_at_5) == [5]


def test_what_shows_in_no_gradient_is_found_before_it_is_saved(small_scene, at_5, monkeypatch):
    """A moment of infinity stops its parameter, and the loss stays finite."""
    name = "gaussians.adam.means.exp_avg_sq"
    inject(monkeypatch, loop, lambda state, *_: tensors_of(state), name, math.inf, True)
    with pytest.raises(NotFiniteError) as caught:
        go_on(small_scene, at_5)
    message = str(caught.value)
    for part in (name, "step 10", str(at_5.checkpoint_file(5)), "learning rate"):
        assert part in message


def test_gradients_whose_squares_overflow_are_skipped(small_scene, at_5, monkeypatch):
    """Adam would keep an infinite square for good."""

    def before(state, *rest):
        means = state.gaussian_optimizer.gaussians.means
        return means.register_hook(lambda g: g * 0 + (1e30 if state.step == AT else 1)).remove

    around_steps(monkeypatch, loop, before)
    go_on(small_scene, at_5)
    assert '"step": 9, "skipped"' in at_5.log_file.read_text()
    assert saved(at_5) == [5, 10]
