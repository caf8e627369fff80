from __future__ import annotations

import gc
import json
import signal
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count, cycle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from mrgs.data import load_scene
from mrgs.errors import ConfigError, DeviceError, MrgsWarning, RunError, SceneError, TrainingError
from mrgs.method.config import from_yaml
from mrgs.method.density.adaptive import AdaptiveDensityControl
from mrgs.method.losses.term import LossContext, Term
from mrgs.render import render
from mrgs.run_files.checkpoint import load_facts
from mrgs.run_files.facts import CheckpointFacts
from mrgs.run_files.folder import RunFolder
from mrgs.run_files.record import RunRecord
from mrgs.runs.open import load_run
from mrgs.scene import RGB, THERMAL, Camera, Pixels, PosedImage, View
from mrgs.training import METHODS, StepStatistics, train
from mrgs.training.checkpoint import load_model
from mrgs.training.start import Hooks, TrainingPart, TrainOptions, open_training
from mrgs.training.state import initial_state
from tests.helpers.changed_views import with_cameras
from tests.helpers.checkpoints import rewrite
from tests.helpers.runs import trained_run
from tests.helpers.training import short_config


def read_log(folder: RunFolder) -> list[dict]:
    return [json.loads(line) for line in folder.log_file.read_text().splitlines()]


def same_tensors(one: Path, other: Path) -> bool:
    """Whether two checkpoints hold the same bits."""
    found, expected = load_file(one), load_file(other)
    return found.keys() == expected.keys() and all(
        torch.equal(found[name], expected[name]) for name in expected
    )


class Spoilt(Term):
    """Makes the loss NaN in some steps."""

    name = "spoilt"

    def __init__(self, *steps: int) -> None:
        self._steps = steps

    def weight(self, step: int) -> float:
        return float("nan") if step in self._steps else 1.0

    def value(self, context: LossContext) -> torch.Tensor:
        return 0 * context.gaussians.means.sum()


class InStep(Term):
    """Has something happen in the middle of a step, and nothing to say of the loss."""

    name = "in_step"

    def __init__(self, number: int, action: Callable[[], object]) -> None:
        self._number, self._action = number, action

    def is_due(self, step: int) -> bool:
        if step == self._number:
            self._action()
        return False

    def value(self, context: LossContext) -> None:
        return None


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def eventful(method: str):
    """60 steps in which everything happens on both sides of step 32."""
    config = short_config(method, max_steps=60, sh_every=13, neighbours_every=11)
    schedule = replace(
        config.densification,
        start=3,
        stop=57,
        every=8,
        reset_every=18,
        gradient_threshold=2e-5,
        clone_below=0.04,
        max_gaussians=2_000,
    )
    return replace(config, densification=schedule)


def test_temperatures_depend_on_the_view_where_a_camera_may_make_them(make_scene):
    config = short_config("mrgs-plus")
    scene = load_scene(make_scene())
    without_celsius = replace(scene, temperature=None)
    colors_alone = replace(
        without_celsius,
        train=tuple(View(view.name, {RGB: view.images[RGB]}) for view in scene.train),
    )
    bands = [
        initial_state(scene, changed).model.gaussians.sh_rest[THERMAL].shape[1]
        for scene, changed in (
            (scene, config),
            (without_celsius, config),
            (colors_alone, config),
            (scene, replace(config, temperature_sh_degree=1)),
            (without_celsius, replace(config, temperature_sh_degree=0)),
            (scene, short_config("3dgs-rgbt")),
        )
    ]
    assert bands == [0, 15, 0, 3, 0, 15]


def test_training_learns_the_scene(small_scene, tmp_path):
    statistics = []
    folder = train(
        small_scene, tmp_path / "run", short_config(), hooks=Hooks(on_step=statistics.append)
    )
    assert [entry.step for entry in statistics] == list(range(1, 61))
    assert statistics[-1].gaussians == 25
    first, last = statistics[:6], statistics[-6:]  # one round of the views
    assert sum(entry.terms["rgb"] for entry in last) < 0.6 * sum(
        entry.terms["rgb"] for entry in first
    )
    assert sum(entry.thermal_error for entry in last) < 0.5 * sum(
        entry.thermal_error for entry in first
    )

    scene = load_scene(small_scene)
    model, _, _ = load_model(folder.newest_checkpoint(), folder.read_config(from_yaml))
    for view in scene.eval:
        with torch.no_grad():
            rendering, _ = render(model, view.cameras)
        photo = view.images[THERMAL].load().values
        assert (
            rendering[THERMAL].image - photo
        ).abs().mean() < 0.5 * photo.mean()  # half the error of a black image


def test_run_folder_holds_configuration_log_and_two_checkpoints(small_scene, tmp_path):
    config = short_config(max_steps=45, checkpoint_every=10)
    folder = train(small_scene, tmp_path / "a" / "run", config)
    names = sorted(
        path.relative_to(folder.path).as_posix()
        for path in folder.path.rglob("*")
        if path.is_file()
    )
    kept = ["checkpoints/step_000040.safetensors", "checkpoints/step_000045.safetensors"]
    assert names == [".lock", *kept, "config.yaml", "log.jsonl"]
    assert folder.read_config(from_yaml) == config

    log = read_log(folder)
    assert [entry["step"] for entry in log] == [10, 20, 30, 40, 45]
    assert set(log[0]) == {
        "step", "loss", "loss_rgb", "loss_thermal", "loss_smooth", "loss_boltzmann",
        "thermal_error_c", "gaussians", "seconds",
    }  # fmt: skip
    assert 0.1 < log[0]["thermal_error_c"] < 20
    seconds = [entry["seconds"] for entry in log]
    assert seconds == sorted(seconds)

    facts = load_facts(folder.newest_checkpoint())
    scene = load_scene(small_scene)
    assert (facts.step, facts.scene, facts.skipped_steps) == (45, str(small_scene), 0)
    assert (facts.capture.extent, facts.temperature) == (scene.extent, scene.temperature)
    assert facts.train_seconds > 0
    assert facts.peak_memory_bytes > 2**20


def test_light_and_heat_are_compared_although_their_cameras_differ(make_scene, tmp_path):
    statistics = []
    config = short_config("mrgs-plus", max_steps=2)
    train(
        make_scene(two_cameras=True),
        tmp_path / "run",
        config,
        hooks=Hooks(on_step=statistics.append),
    )
    assert "opaque" in statistics[0].terms


@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains(method, small_scene, tmp_path):
    statistics = []
    folder = train(
        small_scene,
        tmp_path / "run",
        short_config(method, max_steps=3),
        hooks=Hooks(on_step=statistics.append),
    )
    assert [entry.skipped for entry in statistics] == [False] * 3
    expected = {"rgb", "thermal"}
    expected |= set() if method == "3dgs-rgbt" else {"smooth"}
    expected |= {"boltzmann"} if method in ("mrgs", "mrgs-boltz") else set()
    expected |= {"opaque"} if method == "mrgs-plus" else set()
    assert set(statistics[0].terms) == expected
    tensors = load_file(folder.newest_checkpoint())
    assert ("neighbours" in tensors) == (method in ("mrgs", "mrgs-fourier"))
    assert ("gaussians.opacity_logit.thermal" in tensors) == (method != "3dgs-rgbt")


@pytest.mark.filterwarnings("ignore:scene. No view has any")
@pytest.mark.parametrize("method", ["mrgs", "3dgs-rgbt"])
@pytest.mark.parametrize(
    ("options", "terms"),
    [
        ({"rgb": False}, {"thermal"}),
        ({"thermal": False}, {"rgb"}),
        ({"two_cameras": True}, {"rgb", "thermal"}),
    ],
)
def test_every_kind_of_scene_trains(options, terms, method, make_scene, tmp_path):
    statistics = []
    config = short_config(method, max_steps=3)
    folder = train(
        make_scene(**options), tmp_path / "run", config, hooks=Hooks(on_step=statistics.append)
    )
    assert [entry.skipped for entry in statistics] == [False] * 3
    assert set(statistics[0].terms) & {"rgb", "thermal"} == terms
    assert (statistics[0].thermal_error is None) == ("thermal" not in terms)
    shares_opacity = method == "3dgs-rgbt" or len(terms) == 1
    tensors = load_file(folder.newest_checkpoint())
    assert ("gaussians.opacity_logit.thermal" in tensors) == (not shares_opacity)


@pytest.mark.filterwarnings("ignore:scene. No view has any")
@pytest.mark.parametrize("options", [{"rgb": False}, {"thermal": False}])
def test_a_scene_of_one_modality_prunes_what_it_does_not_see(options, make_scene, tmp_path):
    config = short_config(max_steps=40)
    schedule = replace(config.densification, start=20, every=40, stop=40, gradient_threshold=1e9)
    config = replace(config, densification=replace(schedule, prune_opacity=0.11, reset_opacity=0.5))
    folder = train(make_scene(**options), tmp_path / "run", config)
    tensors = load_file(folder.newest_checkpoint())
    assert 0 < len(tensors["gaussians.means"]) < 25


@pytest.mark.parametrize(
    ("method", "cut", "degree"),
    [("mrgs", 32, 0), pytest.param("mrgs", 36, 3, marks=pytest.mark.slow), ("3dgs-rgbt", 32, 3)],
)
def test_a_resumed_run_is_the_uninterrupted_run_bit_for_bit(
    method, cut, degree, small_scene, tmp_path
):
    # Step 32 densifies, so that there are no neighbours to save; step 36 is between two
    # densifications.
    config = replace(eventful(method), temperature_sh_degree=degree)
    whole = train(small_scene, tmp_path / "whole", config)
    parts = train(small_scene, tmp_path / "parts", config, stop_at=cut)
    assert load_facts(parts.newest_checkpoint()).step == cut
    # The caller's configuration and torch's own generator must not matter.
    torch.rand(7)
    train(
        small_scene,
        tmp_path / "parts",
        short_config(max_steps=7),
        options=TrainOptions(resume=True),
    )

    expected, found = load_file(whole.newest_checkpoint()), load_file(parts.newest_checkpoint())
    assert load_facts(parts.newest_checkpoint()).step == 60
    assert set(found) == set(expected)
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []
    logs = [[{**entry, "seconds": None} for entry in read_log(folder)] for folder in (whole, parts)]
    assert logs[0] == logs[1]

    counts = {
        entry["step"]: entry["gaussians"] for entry in read_log(whole)
    }  # the test must have met the events
    assert len({counts[number] for number in (10, 20, 30)}) > 2
    assert len({counts[number] for number in (40, 50, 60)}) > 2
    assert expected["gaussians.adam.sh_dc.thermal.step"] == 60  # none was skipped


def test_a_checkpoint_of_a_densification_step_can_be_rendered(small_scene, tmp_path):
    train(small_scene, tmp_path / "run", eventful("mrgs"), stop_at=32)
    run = load_run(tmp_path / "run")
    assert "neighbours" not in load_file(run.folder.newest_checkpoint())
    assert run.render(load_scene(small_scene).train[0].camera)[THERMAL].image.isfinite().all()


def test_the_seed_decides(small_scene, tmp_path):
    def final(name: str, seed: int) -> torch.Tensor:
        folder = train(small_scene, tmp_path / name, short_config(max_steps=5, seed=seed))
        return load_file(folder.newest_checkpoint())["gaussians.sh_dc.rgb"]

    first = final("a", seed=1)
    assert torch.equal(first, final("b", seed=1))
    assert not torch.equal(first, final("c", seed=2))


@pytest.mark.slow
def test_a_run_that_died_in_a_step_goes_on_from_the_last_checkpoint(small_scene, tmp_path):
    config = short_config(max_steps=60, checkpoint_every=20)
    whole = train(small_scene, tmp_path / "whole", config)

    class PowerCutError(Exception):
        pass

    def cut() -> None:
        raise PowerCutError

    with pytest.raises(PowerCutError):
        train(small_scene, tmp_path / "run", config, terms=[InStep(56, cut)])
    folder = RunFolder(tmp_path / "run")
    with folder.log_file.open("a") as file:
        file.write('{"step": 5')  # torn
    assert load_facts(folder.newest_checkpoint()).step == 40
    train(
        small_scene,
        folder.path,
        config,
        options=TrainOptions(resume=True),
        terms=[InStep(56, lambda: None)],
    )
    assert [entry["step"] for entry in read_log(folder)] == [10, 20, 30, 40, 50, 60]
    expected, found = load_file(whole.newest_checkpoint()), load_file(folder.newest_checkpoint())
    assert all(torch.equal(found[name], expected[name]) for name in expected)


@pytest.mark.parametrize("kind", [bool, np.bool_, torch.tensor])
def test_whoever_watches_may_stop_the_run(kind, small_scene, tmp_path):
    folder = train(
        small_scene,
        tmp_path / "run",
        short_config(),
        hooks=Hooks(on_step=lambda statistics: kind(statistics.step == 7)),
    )
    assert load_facts(folder.newest_checkpoint()).step == 7


@pytest.mark.parametrize("answer", [1, "written", [True], torch.tensor([True]), np.ones(3)])
def test_only_true_stops_the_run(answer, small_scene, tmp_path):
    config = short_config(max_steps=3)
    folder = train(
        small_scene, tmp_path / "run", config, hooks=Hooks(on_step=lambda statistics: answer)
    )
    assert load_facts(folder.newest_checkpoint()).step == 3


@pytest.fixture(scope="module")
def stopped_at_7(small_scene, tmp_path_factory) -> RunFolder:
    """Only to be read."""
    output = tmp_path_factory.mktemp("stopped") / "run"
    return train(small_scene, output, short_config(), stop_at=7)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_error_of_whoever_watches_keeps_the_last_step(
    error, small_scene, tmp_path, stopped_at_7
):
    def fail(statistics):
        if statistics.step == 7:
            raise error

    with pytest.raises(error):
        train(small_scene, tmp_path / "run", short_config(), hooks=Hooks(on_step=fail))
    kept = RunFolder(tmp_path / "run").newest_checkpoint()
    assert load_facts(kept).step == 7
    assert same_tensors(kept, stopped_at_7.newest_checkpoint())


def test_ctrl_c_in_a_step_waits_for_its_end(small_scene, tmp_path, stopped_at_7):
    with pytest.raises(KeyboardInterrupt):
        train(small_scene, tmp_path / "run", short_config(), terms=[InStep(7, press)])
    kept = RunFolder(tmp_path / "run").newest_checkpoint()
    assert load_facts(kept).step == 7
    assert same_tensors(kept, stopped_at_7.newest_checkpoint())


def test_a_second_ctrl_c_does_not_wait_and_no_half_of_a_step_is_kept(small_scene, tmp_path):
    def press_twice():
        press()
        press()

    config = short_config(checkpoint_every=5)
    with pytest.raises(KeyboardInterrupt):
        train(small_scene, tmp_path / "run", config, terms=[InStep(7, press_twice)])
    assert load_facts(RunFolder(tmp_path / "run").newest_checkpoint()).step == 5


def test_neither_half_of_a_step_nor_a_training_that_has_ended_is_saved(small_scene, tmp_path):
    def fail():
        raise ZeroDivisionError

    folder, terms = RunFolder(tmp_path / "run"), [InStep(3, fail)]
    with open_training(small_scene, folder.path, short_config(), terms=terms) as opened:
        steps = opened.steps()
        next(steps)
        next(steps)
        with pytest.raises(ZeroDivisionError):
            next(steps)
        with pytest.raises(TrainingError, match="step 3 "):
            opened.save()
    with pytest.raises(RunError, match="load_run"):
        opened.save()
    assert not folder.checkpoints()


def test_a_training_that_has_ended_is_freed_at_once(small_scene, tmp_path):
    """Not when the collector finds it: its memory may be a GPU's."""
    gc.disable()
    try:
        with open_training(small_scene, tmp_path / "run", short_config()) as opened:
            opened.run(stop_at=2)
        trainer = weakref.ref(opened)
        del opened
        assert trainer() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_what_the_caller_has_set_of_torch_changes_nothing(mode, small_scene, tmp_path):
    expected = train(small_scene, tmp_path / "usual", short_config(max_steps=3))
    with mode():
        found = train(small_scene, tmp_path / "own", short_config(max_steps=3))
        assert not torch.is_grad_enabled()
    assert same_tensors(found.newest_checkpoint(), expected.newest_checkpoint())


def test_another_default_type_of_tensors_is_refused(small_scene, tmp_path):
    run = load_run(train(small_scene, tmp_path / "run", short_config(max_steps=3)).path)
    camera = run.load_scene().train[0].camera
    torch.set_default_dtype(torch.float64)
    try:
        for compute in (
            lambda: train(small_scene, tmp_path / "new", short_config(max_steps=3)),
            lambda: load_run(tmp_path / "run"),
            lambda: run.render(camera),
        ):
            with pytest.raises(ConfigError, match="set_default_dtype"):
                compute()
        assert torch.get_default_dtype() == torch.float64
    finally:
        torch.set_default_dtype(torch.float32)
    assert not (tmp_path / "new").exists()


def test_start_is_told_once_with_what_is_in_force(small_scene, tmp_path):
    told = []
    config = short_config(max_steps=4)
    folder = train(
        small_scene,
        tmp_path / "run",
        config,
        hooks=Hooks(on_start=lambda *facts: told.append(facts)),
        stop_at=2,
    )
    other = short_config("3dgs-rgbt")
    train(
        small_scene,
        folder.path,
        other,
        options=TrainOptions(resume=True),
        hooks=Hooks(on_start=lambda *facts: told.append(facts)),
    )
    assert [(scene.name, given) for scene, given in told] == [(small_scene.name, config)] * 2


def test_start_is_told_before_the_model_is_made(small_scene, tmp_path):
    """Making it may compile for a while, and a terminal should not be silent meanwhile."""

    def tell(*_):
        raise KeyboardInterrupt

    config = short_config()
    part = TrainingPart([0], config.densification, lambda *_: pytest.fail("made"))
    with pytest.raises(KeyboardInterrupt):
        train(small_scene, tmp_path / "run", config, hooks=Hooks(on_start=tell), part=part)


def recorded(folder: RunFolder, scene: Path, **options) -> RunRecord:
    """A record whose checkpoints are empty files."""

    def write(path: Path, facts: CheckpointFacts) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()

    folder.path.mkdir()
    facts = CheckpointFacts.at_start(load_scene(scene))
    return RunRecord(folder, facts, short_config(checkpoint_every=4), dict, write, **options)


def statistics_of(step: int, skipped: bool = False) -> StepStatistics:
    return StepStatistics(step, 0.5, {}, None, 25, skipped)


def test_the_time_of_scoring_is_not_training_time(small_scene, tmp_path):
    folder, now = RunFolder(tmp_path / "run"), 0.0
    record = recorded(folder, small_scene, clock=lambda: now)
    for step in range(1, 11):
        now += 2
        record.add(statistics_of(step))
        with record.paused():
            now += 100
    (line,) = read_log(folder)
    assert (line["step"], line["seconds"]) == (10, 20.0)


def test_slow_steps_are_saved_before_their_turn(small_scene, tmp_path):
    def saved_where_a_step_takes(seconds: float, name: str) -> list[int]:
        folder, now = RunFolder(tmp_path / name), 0.0
        record = recorded(folder, small_scene, clock=lambda: now)
        saved = []
        for step in range(1, 8):
            now += seconds
            record.add(statistics_of(step))
            record.save_if_due(8)
            saved.extend([step] * folder.checkpoint_file(step).is_file())
        return saved

    assert saved_where_a_step_takes(1, "fast") == [4]
    assert saved_where_a_step_takes(70, "slow") == [2, 4, 6]
    assert saved_where_a_step_takes(500, "slower") == [1, 2, 3, 4, 5, 6, 7]


def test_steps_that_are_not_finite_are_skipped_and_counted(small_scene, tmp_path):
    terms = [Spoilt(2, 3, 5, 6)]
    folder = train(small_scene, tmp_path / "run", short_config(max_steps=8), terms=terms)
    log = read_log(folder)
    assert [entry["step"] for entry in log] == [2, 3, 5, 6, 8]
    assert all("not finite" in entry["skipped"] for entry in log[:4])
    assert load_facts(folder.newest_checkpoint()).skipped_steps == 4
    assert all(tensor.isfinite().all() for tensor in load_file(folder.newest_checkpoint()).values())


def test_the_log_says_what_a_step_measured_and_of_a_skipped_one_that_it_was(small_scene, tmp_path):
    statistics = {}
    folder = train(
        small_scene,
        tmp_path / "run",
        short_config(max_steps=21),
        hooks=Hooks(on_step=lambda each: statistics.update({each.step: each})),
        terms=[Spoilt(20)],
    )
    lines = {line["step"]: line for line in read_log(folder) if "skipped" not in line}
    assert lines.keys() == {10, 20, 21}
    span_c = load_scene(small_scene).temperature.span_c
    for step in (10, 21):
        assert lines[step]["loss"] == pytest.approx(statistics[step].loss)
        assert lines[step]["thermal_error_c"] == pytest.approx(
            span_c * statistics[step].thermal_error
        )
    assert statistics[20].skipped
    assert {"loss", "thermal_error_c"}.isdisjoint(lines[20])
    assert lines[20]["gaussians"] == statistics[20].gaussians


def test_a_resumed_run_counts_the_time_before_it(small_scene, tmp_path):
    config = short_config(max_steps=20)
    folder = train(small_scene, tmp_path / "run", config, stop_at=10)
    rewrite(folder.newest_checkpoint(), train_seconds=1e6)
    train(small_scene, tmp_path / "run", config, options=TrainOptions(resume=True))
    assert load_facts(folder.newest_checkpoint()).train_seconds > 1e6
    assert read_log(folder)[-1]["seconds"] > 1e6


def test_three_skipped_steps_in_a_row_end_the_run(small_scene, tmp_path):
    config = short_config(max_steps=20, checkpoint_every=2)
    kept = tmp_path / "run/checkpoints/step_000004.safetensors"
    with pytest.raises(TrainingError, match="step 6") as caught:
        train(small_scene, tmp_path / "run", config, terms=[Spoilt(4, 5, 6)])
    assert f"{kept}. Resume" in str(caught.value)
    assert RunFolder(tmp_path / "run").newest_checkpoint() == kept


def test_skipped_steps_are_counted_across_a_resume(small_scene, tmp_path):
    config, terms = short_config(max_steps=20), [Spoilt(4, 5, 6)]
    train(small_scene, tmp_path / "run", config, terms=terms, stop_at=5)
    with pytest.raises(TrainingError, match="at step 6"):
        train(small_scene, tmp_path / "run", config, options=TrainOptions(resume=True), terms=terms)


def test_without_a_checkpoint_the_error_says_so(small_scene, tmp_path):
    terms = [Spoilt(1, 2, 3)]
    with pytest.raises(TrainingError, match="no checkpoint"):
        train(small_scene, tmp_path / "run", short_config(), terms=terms)
    with pytest.raises(RunError, match="no checkpoint"):
        train(
            small_scene,
            tmp_path / "run",
            short_config(),
            options=TrainOptions(resume=True),
            terms=terms,
        )


class Memory:
    """Is full in some of the calls of ``take``, counted from 0."""

    def __init__(self, *full_calls: int) -> None:
        self._full_calls, self._calls = full_calls, count()
        self._errors = cycle(
            [
                torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
                RuntimeError("Triton Error [CUDA]: out of memory"),
            ]
        )

    def take(self) -> None:
        if next(self._calls) in self._full_calls:
            raise next(self._errors)


class TakesMemory(Term):
    """Has nothing to say, for which it needs memory."""

    name = "takes_memory"

    def __init__(self, memory: Memory) -> None:
        self._memory = memory

    def value(self, context: LossContext) -> None:
        if context.rendering[RGB].image.shape[1] == 40:  # not in the check of the kernels
            self._memory.take()


@dataclass(frozen=True)
class TakingMemory(AdaptiveDensityControl):
    """Density control that needs memory in one of its methods."""

    memory: Memory = field(default_factory=Memory)
    where: str = "nowhere"

    def observe(self, passes):
        found = super().observe(passes)
        self._take("observe")
        return found

    def movable(self, gaussians):
        self._take("movable")

    def after_step(self, state, optimizer, step):
        self._take("after_step")
        return super().after_step(state, optimizer, step)

    def _take(self, where: str) -> None:
        if where == self.where:
            self.memory.take()


@pytest.mark.slow
@pytest.mark.parametrize("where", ["loss", "observe", "movable", "after_step"])
def test_where_a_gpus_memory_was_full_once_the_run_is_the_same(
    where, small_scene, tmp_path, tmp_path_factory
):
    config, memory = replace(eventful("mrgs"), max_steps=34), Memory(0, 7, 32)
    whole = RunFolder(trained_run(tmp_path_factory, small_scene, config, tmp_path / "whole"))
    strategy = TakingMemory(**vars(config.densification), memory=memory, where=where)
    terms = [TakesMemory(memory)] if where == "loss" else []
    folder = train(small_scene, tmp_path / "run", config, strategy=strategy, terms=terms)
    expected, found = load_file(whole.newest_checkpoint()), load_file(folder.newest_checkpoint())
    assert len(expected["gaussians.means"]) != 25
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_a_scene_before_the_near_plane_is_doubted(small_scene, tmp_path):
    scene = load_scene(small_scene)
    near = replace(scene, train=tuple(map(a_thousandth, scene.train)))
    near = replace(near, points=replace(scene.points, positions=scene.points.positions / 1000))
    with pytest.warns(MrgsWarning, match=r"% .* by 1,000"):
        train(near, tmp_path / "run", short_config(max_steps=1))


def a_thousandth(view: View) -> View:
    """A view where lengths are a thousandth."""

    def smaller(camera: Camera) -> Camera:
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] /= 1000
        return replace(camera, viewmat=viewmat)

    return with_cameras(view, smaller)


def test_the_next_photos_come_while_a_step_is_computed(small_scene, tmp_path):
    are_coming = threading.Event()

    def read_ahead(image: PosedImage) -> PosedImage:
        def load() -> Pixels:
            if threading.current_thread().name.startswith("mrgs-photos"):
                are_coming.set()
            return image.load()

        return replace(image, load=load, load_at_least=None)

    scene = load_scene(small_scene)
    views = [
        replace(view, images={name: read_ahead(image) for name, image in view.images.items()})
        for view in scene.train
    ]
    came = []
    terms = [InStep(1, lambda: came.append(are_coming.wait(timeout=300)))]
    config = short_config(max_steps=2)
    train(replace(scene, train=tuple(views)), tmp_path / "run", config, terms=terms)
    assert came == [True]


def test_a_training_that_fails_leaves_no_thread(small_scene, tmp_path):
    def readers():
        return {each for each in threading.enumerate() if each.name.startswith("mrgs-photos")}

    def fail(statistics):
        assert readers() - before
        raise ZeroDivisionError

    before = readers()
    with pytest.raises(ZeroDivisionError) as caught:
        train(small_scene, tmp_path / "run", short_config(), hooks=Hooks(on_step=fail))
    assert caught.tb is not None  # it holds the trainer, whose thread has ended nonetheless
    assert readers() <= before


def test_where_memory_stays_full_the_last_good_step_is_kept(small_scene, tmp_path):
    config, terms = short_config(max_steps=20), [TakesMemory(Memory(5, 6))]
    whole = train(small_scene, tmp_path / "whole", config)
    with pytest.raises(TrainingError, match="step 6 with 25 Gaussians") as caught:
        train(small_scene, tmp_path / "run", config, terms=terms)
    kept = tmp_path / "run/checkpoints/step_000005.safetensors"
    assert f"{kept}: resume" in str(caught.value)
    assert caught.value.options == ("max_gaussians", "resolution")
    folder = train(
        small_scene,
        tmp_path / "run",
        config,
        options=TrainOptions(resume=True, device="cpu"),
        terms=terms,
    )
    expected, found = load_file(whole.newest_checkpoint()), load_file(folder.newest_checkpoint())
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_where_memory_does_not_suffice_for_one_step_there_is_nothing_to_keep(small_scene, tmp_path):
    with pytest.raises(TrainingError, match="step 1 "):
        train(small_scene, tmp_path / "run", short_config(), terms=[TakesMemory(Memory(0, 1))])


def test_a_gpu_that_cannot_be_used_is_said_before_anything_is_made(small_scene, tmp_path):
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(DeviceError, match="use the CPU"):
        train(small_scene, tmp_path / "run", short_config(), options=TrainOptions(device="cuda"))
    assert list(tmp_path.iterdir()) == []


def test_the_checkpoint_says_which_device_it_was(small_scene, tmp_path):
    folder = train(small_scene, tmp_path / "run", short_config(max_steps=1))
    assert load_facts(folder.newest_checkpoint()).device == "cpu"


@pytest.mark.parametrize(("device", "is_kept"), [("cpu", True), ("NVIDIA H200", False)])
def test_the_peak_of_memory_is_that_of_one_device(device, is_kept, small_scene, tmp_path):
    config = short_config(max_steps=2)
    folder = train(small_scene, tmp_path / "run", config, stop_at=1)
    rewrite(folder.newest_checkpoint(), device=device, peak_memory_bytes=2**50)
    train(small_scene, folder.path, config, options=TrainOptions(resume=True, device="cpu"))
    facts = load_facts(folder.newest_checkpoint())
    assert (facts.step, facts.device, facts.peak_memory_bytes == 2**50) == (2, "cpu", is_kept)


def test_steps_that_are_looked_at_later_are_counted_all_the_same(small_scene, tmp_path):
    """As on a GPU, where skipped steps are counted after every tenth."""
    folder = RunFolder(tmp_path / "run")
    record = recorded(folder, small_scene, check_every=10)
    for step in range(1, 20):
        record.add(statistics_of(step, step in (2, 3, 12, 13, 14)))
    with pytest.raises(TrainingError, match="step 14"):
        record.add(statistics_of(20))
    assert [entry["step"] for entry in read_log(folder)] == [2, 3, 10, 12, 13, 14]
    assert record.step == 20


@pytest.mark.gpu
@pytest.mark.parametrize(("first", "second"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_a_run_goes_on_on_another_device(first, second, small_scene, tmp_path):
    config = eventful("mrgs-plus")
    folder = train(
        small_scene, tmp_path / "run", config, options=TrainOptions(device=first), stop_at=55
    )
    train(small_scene, folder.path, config, options=TrainOptions(resume=True, device=second))
    facts = load_facts(folder.newest_checkpoint())
    assert (facts.step, facts.device == "cpu", facts.skipped_steps) == (60, second == "cpu", 0)
    assert facts.peak_memory_bytes > 2**20
    assert read_log(folder)[-1]["loss"] < read_log(folder)[0]["loss"]
    assert all(tensor.isfinite().all() for tensor in load_file(folder.newest_checkpoint()).values())


def test_a_run_is_never_overwritten(small_scene, tmp_path):
    config = short_config(max_steps=1)
    folder = train(small_scene, tmp_path / "run", config)
    before = folder.newest_checkpoint().read_bytes()
    with pytest.raises(RunError, match="already holds"):
        train(small_scene, folder.path, config)
    assert folder.newest_checkpoint().read_bytes() == before


def test_a_part_of_a_scene_is_trained_on_its_own_views(small_scene, tmp_path):
    config = short_config()
    part = TrainingPart([1, 3, 4], config.densification, initial_state)
    with open_training(small_scene, tmp_path / "run", config, part=part) as trainer:
        seen = [number for _ in range(6) for number in trainer.state.sampler.next()]
    assert sorted(seen) == [1, 1, 3, 3, 4, 4]


def test_a_scene_that_cannot_be_read_leaves_no_run(tmp_path):
    with pytest.raises(SceneError, match="nowhere"):
        train(tmp_path / "nowhere", tmp_path / "run", short_config())
    assert list(tmp_path.iterdir()) == []


def test_a_resumed_run_needs_its_own_scene(small_scene, make_scene, tmp_path):
    config = short_config(max_steps=4)
    folder = train(small_scene, tmp_path / "run", config, stop_at=2)
    other = make_scene()
    content = json.loads((other / "transforms.json").read_text())
    (other / "transforms.json").write_text(json.dumps({**content, "frames": content["frames"][:4]}))
    with pytest.raises(RunError, match=f"{other.name} has 3 "):
        train(other, folder.path, config, options=TrainOptions(resume=True))


def test_training_leaves_the_callers_random_numbers_alone(small_scene, tmp_path):
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    train(small_scene, tmp_path / "run", short_config(max_steps=2))
    assert torch.equal(torch.rand(4), expected)
