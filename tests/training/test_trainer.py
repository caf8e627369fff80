from __future__ import annotations

import json
import signal
import threading
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from mrgs.data import load_scene
from mrgs.errors import ConfigError, DeviceError, MrgsWarning, RunError, SceneError, TrainingError
from mrgs.method.config import from_yaml
from mrgs.method.density import adaptive
from mrgs.method.optimizer import GaussianOptimizer
from mrgs.render import render_view
from mrgs.runs.open import load_run
from mrgs.scene import RGB, THERMAL, Camera, View
from mrgs.training import METHODS, driver, train, trainer, view_pass
from mrgs.training.checkpoint import load_facts, load_model
from mrgs.training.opening import TrainingPart, open_training
from mrgs.training.photos import HostPhotos
from mrgs.training.run_folder import RunFolder
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


def spoil(monkeypatch: pytest.MonkeyPatch, bad_steps: set[int], first: int = 1) -> None:
    """Make the loss NaN in these steps of the next run, which starts at step ``first``."""
    steps = iter(range(first, 1_000_000))
    original = view_pass.total_loss

    def total_loss(*args, **kwargs):
        loss = original(*args, **kwargs)
        return loss * float("nan") if next(steps) in bad_steps else loss

    monkeypatch.setattr(view_pass, "total_loss", total_loss)


def eventful(method: str):
    """120 steps in which everything happens on both sides of step 60."""
    config = short_config(method, max_steps=120, sh_every=27, neighbours_every=21)
    schedule = replace(
        config.densification,
        start=5,
        stop=114,
        every=15,
        reset_every=36,
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
    folder = train(small_scene, tmp_path / "run", short_config(), on_step=statistics.append)
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
        rendering = render_view(model, view)
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
    train(make_scene(two_cameras=True), tmp_path / "run", config, on_step=statistics.append)
    assert "opaque" in statistics[0].terms


@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains(method, small_scene, tmp_path):
    statistics = []
    folder = train(
        small_scene,
        tmp_path / "run",
        short_config(method, max_steps=3),
        on_step=statistics.append,
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
    folder = train(make_scene(**options), tmp_path / "run", config, on_step=statistics.append)
    assert [entry.skipped for entry in statistics] == [False] * 3
    assert set(statistics[0].terms) & {"rgb", "thermal"} == terms
    assert (statistics[0].thermal_error is None) == ("thermal" not in terms)
    shares_opacity = method == "3dgs-rgbt" or len(terms) == 1
    tensors = load_file(folder.newest_checkpoint())
    assert ("gaussians.opacity_logit.thermal" in tensors) == (not shares_opacity)


@pytest.mark.parametrize("options", [{"rgb": False}, {"thermal": False}])
def test_a_scene_of_one_modality_prunes_what_it_does_not_see(options, make_scene, tmp_path):
    config = short_config(max_steps=40)
    schedule = replace(config.densification, start=20, every=40, stop=40, gradient_threshold=1e9)
    config = replace(config, densification=replace(schedule, prune_opacity=0.11, reset_opacity=0.5))
    folder = train(make_scene(**options), tmp_path / "run", config)
    tensors = load_file(folder.newest_checkpoint())
    assert 0 < len(tensors["gaussians.means"]) < 25


@pytest.mark.parametrize(
    ("method", "cut", "degree"), [("mrgs", 60, 0), ("mrgs", 68, 3), ("3dgs-rgbt", 60, 3)]
)
def test_a_resumed_run_is_the_uninterrupted_run_bit_for_bit(
    method, cut, degree, small_scene, tmp_path
):
    # Step 60 densifies, so that there are no neighbours to save; step 68 lies between two
    # densifications.
    config = replace(eventful(method), temperature_sh_degree=degree)
    whole = train(small_scene, tmp_path / "whole", config)
    parts = train(small_scene, tmp_path / "parts", config, stop_at=cut)
    assert load_facts(parts.newest_checkpoint()).step == cut
    # The caller's configuration and torch's own generator must not matter.
    torch.rand(7)
    train(small_scene, tmp_path / "parts", short_config(max_steps=7), resume=True)

    expected, found = load_file(whole.newest_checkpoint()), load_file(parts.newest_checkpoint())
    assert load_facts(parts.newest_checkpoint()).step == 120
    assert set(found) == set(expected)
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []
    logs = [[{**entry, "seconds": None} for entry in read_log(folder)] for folder in (whole, parts)]
    assert logs[0] == logs[1]

    counts = {
        entry["step"]: entry["gaussians"] for entry in read_log(whole)
    }  # the test must have met the events
    assert len({counts[number] for number in (10, 20, 40, 50)}) > 2
    assert len({counts[number] for number in (70, 80, 100, 110)}) > 2
    assert expected["gaussians.adam.sh_dc.thermal.step"] == 120  # none was skipped


def test_a_checkpoint_of_a_densification_step_can_be_rendered(small_scene, tmp_path):
    train(small_scene, tmp_path / "run", eventful("mrgs"), stop_at=60)
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


def in_step(monkeypatch, number, action):
    """Have an action take place in the middle of a training step."""
    original = trainer.training_step

    def step(state, *others):
        result = original(state, *others)
        if state.step == number:
            action()
        return result

    monkeypatch.setattr(trainer, "training_step", step)


def test_a_run_that_died_in_a_step_goes_on_from_the_last_checkpoint(
    small_scene, tmp_path, monkeypatch
):
    config = short_config(max_steps=60, checkpoint_every=20)
    whole = train(small_scene, tmp_path / "whole", config)

    class PowerCutError(Exception):
        pass

    def cut() -> None:
        raise PowerCutError

    with monkeypatch.context() as patch:
        in_step(patch, 56, cut)
        with pytest.raises(PowerCutError):
            train(small_scene, tmp_path / "run", config)
    folder = RunFolder(tmp_path / "run")
    with folder.log_file.open("a") as file:
        file.write('{"step": 5')  # torn
    assert load_facts(folder.newest_checkpoint()).step == 40
    train(small_scene, folder.path, config, resume=True)
    assert [entry["step"] for entry in read_log(folder)] == [10, 20, 30, 40, 50, 60]
    expected, found = load_file(whole.newest_checkpoint()), load_file(folder.newest_checkpoint())
    assert all(torch.equal(found[name], expected[name]) for name in expected)


@pytest.mark.parametrize("kind", [bool, np.bool_, torch.tensor])
def test_whoever_watches_may_stop_the_run(kind, small_scene, tmp_path):
    folder = train(
        small_scene,
        tmp_path / "run",
        short_config(),
        on_step=lambda statistics: kind(statistics.step == 7),
    )
    assert load_facts(folder.newest_checkpoint()).step == 7


@pytest.mark.parametrize("answer", [1, "written", [True], torch.tensor([True]), np.ones(3)])
def test_only_true_stops_the_run(answer, small_scene, tmp_path):
    config = short_config(max_steps=3)
    folder = train(small_scene, tmp_path / "run", config, on_step=lambda statistics: answer)
    assert load_facts(folder.newest_checkpoint()).step == 3


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_error_of_whoever_watches_keeps_the_last_step(error, small_scene, tmp_path):
    def fail(statistics):
        if statistics.step == 7:
            raise error

    with pytest.raises(error):
        train(small_scene, tmp_path / "run", short_config(), on_step=fail)
    stopped = train(small_scene, tmp_path / "stopped", short_config(), stop_at=7)
    kept = RunFolder(tmp_path / "run").newest_checkpoint()
    assert load_facts(kept).step == 7
    assert same_tensors(kept, stopped.newest_checkpoint())


def test_ctrl_c_in_a_step_waits_for_its_end(small_scene, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        in_step(patch, 7, lambda: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(small_scene, tmp_path / "run", short_config())
    stopped = train(small_scene, tmp_path / "stopped", short_config(), stop_at=7)
    kept = RunFolder(tmp_path / "run").newest_checkpoint()
    assert load_facts(kept).step == 7
    assert same_tensors(kept, stopped.newest_checkpoint())


def test_a_second_ctrl_c_does_not_wait_and_no_half_of_a_step_is_kept(
    small_scene, tmp_path, monkeypatch
):
    def press_twice():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    in_step(monkeypatch, 7, press_twice)
    with pytest.raises(KeyboardInterrupt):
        train(small_scene, tmp_path / "run", short_config(checkpoint_every=5))
    assert load_facts(RunFolder(tmp_path / "run").newest_checkpoint()).step == 5


def test_neither_half_of_a_step_nor_a_training_that_has_ended_is_saved(
    small_scene, tmp_path, monkeypatch
):
    def fail():
        raise ZeroDivisionError

    folder = RunFolder(tmp_path / "run")
    in_step(monkeypatch, 3, fail)
    with open_training(small_scene, folder.path, short_config()) as opened:
        steps = opened.steps()
        next(steps)
        next(steps)
        with pytest.raises(ZeroDivisionError):
            next(steps)
        with pytest.raises(TrainingError, match="step 3 was interrupted half-way"):
            opened.save()
    with pytest.raises(RunError, match=r"the training has ended: open the run with load_run\("):
        opened.save()
    assert not folder.checkpoints()


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
            with pytest.raises(ConfigError, match=r"is torch.float64.* need float32: call torch"):
                compute()
        assert torch.get_default_dtype() == torch.float64
    finally:
        torch.set_default_dtype(torch.float32)
    assert not (tmp_path / "new").exists()


def test_start_is_told_once_with_what_is_in_force(small_scene, tmp_path):
    told = []
    config = short_config(max_steps=4)
    folder = train(
        small_scene, tmp_path / "run", config, stop_at=2, on_start=lambda *facts: told.append(facts)
    )
    other = short_config("3dgs-rgbt")
    train(small_scene, folder.path, other, resume=True, on_start=lambda *facts: told.append(facts))
    assert [(scene.name, given) for scene, given in told] == [(small_scene.name, config)] * 2


def test_start_is_told_before_the_model_is_made(small_scene, tmp_path, monkeypatch):
    """Making it may compile for a while, and a terminal should not be silent meanwhile."""

    def tell(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("mrgs.training.opening.initial_state", lambda *_: pytest.fail("made"))
    with pytest.raises(KeyboardInterrupt):
        train(small_scene, tmp_path / "run", short_config(), on_start=tell)


def test_slow_steps_are_saved_before_their_turn(small_scene, tmp_path, monkeypatch):
    monkeypatch.setattr("mrgs.training.driver.SAVE_EVERY_S", 0.0)
    monkeypatch.setattr("mrgs.training.driver.SAVE_SHARE", float("inf"))
    config = short_config(max_steps=8, checkpoint_every=4)
    saved: list[int] = []

    def note(statistics):
        newest = tmp_path / f"run/checkpoints/step_{statistics.step - 1:06d}.safetensors"
        saved.extend([statistics.step - 1] * newest.is_file())

    train(small_scene, tmp_path / "run", config, on_step=note)
    assert saved == [1, 2, 3, 4, 5, 6, 7]


def test_steps_that_are_not_finite_are_skipped_and_counted(small_scene, tmp_path, monkeypatch):
    spoil(monkeypatch, {2, 3, 5, 6})
    folder = train(small_scene, tmp_path / "run", short_config(max_steps=8))
    log = read_log(folder)
    assert [entry["step"] for entry in log] == [2, 3, 5, 6, 8]
    assert all(entry["skipped"] == "the loss or a gradient was not finite" for entry in log[:4])
    assert load_facts(folder.newest_checkpoint()).skipped_steps == 4
    assert all(tensor.isfinite().all() for tensor in load_file(folder.newest_checkpoint()).values())


def test_the_log_says_what_a_step_measured_and_of_a_skipped_one_that_it_was(
    small_scene, tmp_path, monkeypatch
):
    spoil(monkeypatch, {20})
    statistics = {}
    folder = train(
        small_scene,
        tmp_path / "run",
        short_config(max_steps=21),
        on_step=lambda each: statistics.update({each.step: each}),
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
    train(small_scene, tmp_path / "run", config, resume=True)
    assert load_facts(folder.newest_checkpoint()).train_seconds > 1e6
    assert read_log(folder)[-1]["seconds"] > 1e6


def test_three_skipped_steps_in_a_row_end_the_run(small_scene, tmp_path, monkeypatch):
    spoil(monkeypatch, {4, 5, 6})
    config = short_config(max_steps=20, checkpoint_every=2)
    with pytest.raises(TrainingError) as caught:
        train(small_scene, tmp_path / "run", config)
    kept = tmp_path / "run/checkpoints/step_000004.safetensors"
    assert str(caught.value) == (
        "3 steps in a row gave values that are not finite, at step 6; "
        f"the last good checkpoint is {kept}. "
        "Resume with a smaller learning rate, or check the scene's poses and images"
    )
    assert RunFolder(tmp_path / "run").newest_checkpoint() == kept


def test_skipped_steps_are_counted_across_a_resume(small_scene, tmp_path, monkeypatch):
    spoil(monkeypatch, {4, 5, 6})
    config = short_config(max_steps=20)
    train(small_scene, tmp_path / "run", config, stop_at=5)
    with pytest.raises(TrainingError, match="at step 6"):
        train(small_scene, tmp_path / "run", config, resume=True)


def test_without_a_checkpoint_the_error_says_so(small_scene, tmp_path, monkeypatch):
    spoil(monkeypatch, {1, 2, 3})
    with pytest.raises(TrainingError, match="there is no checkpoint yet"):
        train(small_scene, tmp_path / "run", short_config())
    with pytest.raises(RunError, match="run has no checkpoint yet: train it first"):
        train(small_scene, tmp_path / "run", short_config(), resume=True)


def fill_memory(monkeypatch: pytest.MonkeyPatch, owner: object, name: str, calls: set[int]) -> None:
    """Let the GPU's memory be full in these calls of a module's or class's function, counted from
    0."""
    count = iter(range(1_000_000))
    original = getattr(owner, name)
    errors = cycle(
        [
            torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
            RuntimeError("Triton Error [CUDA]: out of memory"),
        ]
    )

    def full(*args, **kwargs):
        if next(count) in calls:
            raise next(errors)
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, full)


@pytest.mark.parametrize(
    ("owner", "name", "calls"),
    [
        (view_pass, "total_loss", {0, 7, 60}),
        (view_pass, "_thermal_error", {0, 7, 60}),
        (adaptive.AdaptiveDensityControl, "observe", {0, 7, 60}),
        (GaussianOptimizer, "step", {0, 7, 60}),
        (HostPhotos, "fetch", {0, 7, 20}),
        (adaptive, "densify", {0, 2}),
        (adaptive, "_no_views", {1, 3}),  # the first is that of the start
        (GaussianOptimizer, "replace_rows", {0, 2}),
    ],
)
def test_where_a_gpus_memory_was_full_once_the_run_is_the_same(
    owner, name, calls, small_scene, tmp_path, tmp_path_factory, monkeypatch
):
    config = replace(eventful("mrgs"), max_steps=64)
    whole = RunFolder(trained_run(tmp_path_factory, small_scene, config, tmp_path / "whole"))
    fill_memory(monkeypatch, owner, name, calls)
    folder = train(small_scene, tmp_path / "run", config)
    expected, found = load_file(whole.newest_checkpoint()), load_file(folder.newest_checkpoint())
    assert len(expected["gaussians.means"]) != 25
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_photos_for_which_there_is_no_memory_are_not_fetched(small_scene, tmp_path, monkeypatch):
    released = []
    fill_memory(monkeypatch, HostPhotos, "fetch", {0})
    monkeypatch.setattr(HostPhotos, "release", lambda self: released.append(self))
    monkeypatch.setattr(
        torch.cuda, "empty_cache", lambda: pytest.fail("the step itself had enough memory")
    )
    train(small_scene, tmp_path / "run", short_config(max_steps=2))
    assert len(released) == 1


def test_a_scene_before_the_near_plane_is_doubted(small_scene, tmp_path):
    scene = load_scene(small_scene)
    near = replace(scene, train=tuple(map(a_thousandth, scene.train)))
    near = replace(near, points=replace(scene.points, positions=scene.points.positions / 1000))
    message = (
        "100% of what the cameras see lies nearer than 0.01 units, where nothing is rendered. "
        "Scale the poses and the points together, such as by 1,000."
    )
    with pytest.warns(MrgsWarning, match=message):
        train(near, tmp_path / "run", short_config(max_steps=1))


def a_thousandth(view: View) -> View:
    """A view where lengths are a thousandth."""

    def smaller(camera: Camera) -> Camera:
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] /= 1000
        return replace(camera, viewmat=viewmat)

    return with_cameras(view, smaller)


def test_the_next_photos_come_while_a_step_is_computed(small_scene, tmp_path, monkeypatch):
    events = []

    def noted(name, original):
        return lambda *args, **kwargs: (events.append(name), original(*args, **kwargs))[1]

    monkeypatch.setattr(HostPhotos, "fetch", noted("fetch", HostPhotos.fetch))
    monkeypatch.setattr(trainer, "training_step", noted("step", trainer.training_step))
    train(small_scene, tmp_path / "run", short_config(max_steps=2))
    assert events == ["fetch", "step", "fetch", "step"]


def test_a_training_that_fails_leaves_no_thread(small_scene, tmp_path):
    def readers():
        return {each for each in threading.enumerate() if each.name.startswith("mrgs-photos")}

    def fail(statistics):
        assert readers() - before
        raise ZeroDivisionError

    before = readers()
    with pytest.raises(ZeroDivisionError) as caught:
        train(small_scene, tmp_path / "run", short_config(), on_step=fail)
    assert caught.tb is not None  # it holds the trainer, whose thread has ended nonetheless
    assert readers() <= before


def test_where_memory_stays_full_the_last_good_step_is_kept(small_scene, tmp_path, monkeypatch):
    config = short_config(max_steps=20)
    whole = train(small_scene, tmp_path / "whole", config)
    with monkeypatch.context() as patch:
        fill_memory(patch, view_pass, "total_loss", {5, 6})
        with pytest.raises(TrainingError) as caught:
            train(small_scene, tmp_path / "run", config)
    kept = tmp_path / "run/checkpoints/step_000005.safetensors"
    assert str(caught.value) == (
        f"the GPU's memory does not suffice for step 6 with 25 Gaussians; the last good step is "
        f"kept in {kept}: "
        "resume on the CPU, or retrain with fewer Gaussians or a lower resolution"
    )
    folder = train(small_scene, tmp_path / "run", config, resume=True, device="cpu")
    expected, found = load_file(whole.newest_checkpoint()), load_file(folder.newest_checkpoint())
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_where_memory_does_not_suffice_for_one_step_there_is_nothing_to_keep(
    small_scene, tmp_path, monkeypatch
):
    fill_memory(monkeypatch, view_pass, "total_loss", {0, 1})
    with pytest.raises(TrainingError) as caught:
        train(small_scene, tmp_path / "run", short_config())
    assert str(caught.value) == (
        "the GPU's memory does not suffice for step 1 with 25 Gaussians; there is no checkpoint "
        "yet: "
        "retrain with fewer Gaussians or a lower resolution"
    )


def test_a_gpu_that_cannot_be_used_is_said_before_anything_is_made(small_scene, tmp_path):
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(DeviceError, match="use the CPU"):
        train(small_scene, tmp_path / "run", short_config(), device="cuda")
    assert list(tmp_path.iterdir()) == []


def test_the_checkpoint_says_which_device_it_was(small_scene, tmp_path):
    folder = train(small_scene, tmp_path / "run", short_config(max_steps=1))
    assert load_facts(folder.newest_checkpoint()).device == "cpu"


@pytest.mark.parametrize(("second", "expected"), [("cpu", 2**40), ("NVIDIA H200", 2**30)])
def test_the_peak_of_memory_is_that_of_one_device(
    second, expected, small_scene, tmp_path, monkeypatch
):
    config = short_config(max_steps=2)
    for title, peak, stop_at in (("cpu", 2**40, 1), (second, 2**30, 2)):
        monkeypatch.setattr(driver.gpu, "device_title", lambda device, title=title: title)
        monkeypatch.setattr(driver, "peak_memory_bytes", lambda device, peak=peak: peak)
        folder = train(small_scene, tmp_path / "run", config, resume=stop_at == 2, stop_at=stop_at)
    facts = load_facts(folder.newest_checkpoint())
    assert (facts.device, facts.peak_memory_bytes) == (second, expected)


def test_steps_that_are_looked_at_later_are_counted_all_the_same(
    small_scene, tmp_path, monkeypatch
):
    """As on a GPU, where the driver looks every tenth step."""
    monkeypatch.setattr(driver, "CHECK_EVERY", {"cpu": 10})
    spoil(monkeypatch, {2, 3, 12, 13, 14})
    config = short_config(max_steps=60, checkpoint_every=5)
    with pytest.raises(
        TrainingError, match="3 steps in a row gave values that are not finite, at step 14"
    ):
        train(small_scene, tmp_path / "run", config)
    folder = RunFolder(tmp_path / "run")
    assert [entry["step"] for entry in read_log(folder)] == [2, 3, 10, 12, 13, 14]
    assert load_facts(folder.newest_checkpoint()).step == 10


@pytest.mark.gpu
@pytest.mark.parametrize(("first", "second"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_a_run_goes_on_on_another_device(first, second, small_scene, tmp_path):
    config = eventful("mrgs-plus")
    folder = train(small_scene, tmp_path / "run", config, stop_at=110, device=first)
    train(small_scene, folder.path, config, resume=True, device=second)
    facts = load_facts(folder.newest_checkpoint())
    assert (facts.step, facts.device == "cpu", facts.skipped_steps) == (120, second == "cpu", 0)
    assert facts.peak_memory_bytes > 2**20
    assert read_log(folder)[-1]["loss"] < read_log(folder)[0]["loss"]
    assert all(tensor.isfinite().all() for tensor in load_file(folder.newest_checkpoint()).values())


def test_a_run_is_never_overwritten(small_scene, tmp_path):
    config = short_config(max_steps=1)
    folder = train(small_scene, tmp_path / "run", config)
    before = folder.newest_checkpoint().read_bytes()
    with pytest.raises(RunError, match="run already holds a run: resume it, or choose another"):
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
    with pytest.raises(RunError) as caught:
        train(other, folder.path, config, resume=True)
    assert str(caught.value) == (
        f"{other.name} has 3 training views of 6 images, not the 6 that the run was trained with: "
        f"use that scene as it was"
    )


def test_training_leaves_the_callers_random_numbers_alone(small_scene, tmp_path):
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    train(small_scene, tmp_path / "run", short_config(max_steps=2))
    assert torch.equal(torch.rand(4), expected)
