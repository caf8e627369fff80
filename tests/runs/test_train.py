"""Training from Python, from arrays to a model and back."""

from __future__ import annotations

import gc
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import NamedTuple, NoReturn

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from mrgs import (
    evaluate_run,
    export_run,
    load_run,
    load_scene,
    make_config,
    report_run,
    train,
    train_steps,
)
from mrgs.errors import ConfigError, DeviceError, MrgsWarning, RunError, SceneError
from mrgs.marks.run_marks import spot_radius
from mrgs.method.losses.term import LossContext, Term
from mrgs.run_files.folder import RunFolder
from mrgs.scene import RGB, THERMAL, Pixels, Scene, View
from mrgs.training import train as train_into
from mrgs.training.loop import Trainer, Validation
from mrgs.training.start import Hooks
from tests.helpers.array_checks import unchecked
from tests.helpers.runs import trained_run

CONFIG = make_config("mrgs", "fast", max_steps=6, max_gaussians=60)


def from_arrays(folder: Path) -> Scene:
    """The small scene from arrays, its views in the same order."""
    scene = load_scene(folder)
    assert scene.temperature is not None

    def arrays(read: Callable[[View], np.ndarray]) -> np.ndarray:
        return np.stack([read(view) for view in scene.train])

    celsius = scene.temperature.to_celsius
    return Scene.from_arrays(
        scene.train_cameras,
        rgb=arrays(lambda view: view.images[RGB].load().values.numpy()),
        celsius=arrays(lambda view: celsius(view.images[THERMAL].load().values[..., 0].numpy())),
        points=scene.points.positions,
        colors=scene.points.colors,
        eval_every=3,
    )


def same_files(one: Path, other: Path) -> bool:
    first, second = load_file(one), load_file(other)
    return first.keys() == second.keys() and all(
        torch.equal(first[name], second[name]) for name in first
    )


def test_from_arrays_to_scores_and_files_without_a_folder(small_scene: Path, tmp_path: Path):
    scene = from_arrays(small_scene)
    run = train(scene, config=CONFIG)
    place = run.folder.path
    assert (run.load_scene(), run.facts.scene) == (scene, "")
    assert repr(run).startswith("Run(mrgs, step 6, ")
    metrics = evaluate_run(run)
    assert [view.name for view in metrics.views] == [view.name for view in scene.eval]
    assert json.loads((place / "eval" / "metrics.json").read_text())["scene"] == "scene"
    parts: list[str] = []
    written = export_run(run, tmp_path, "points", progress=lambda *told: parts.append(told[2]))
    assert [path.name for path in written] == ["points.ply", "points.ply.json"]
    assert parts[-1] == "points"
    assert "Thermal report: scene" in report_run(run).read_text()
    del run
    gc.collect()
    assert not place.exists(), "a temporary run goes with its last reference"


@pytest.fixture
def whole(small_scene: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A training of the small scene's folder, without a break; a run of its own."""
    return RunFolder(trained_run(tmp_path_factory, small_scene, CONFIG, tmp_path / "whole"))


def test_the_folder_gives_the_same_run_as_the_scene_read_from_it(whole, small_scene, tmp_path):
    other = train(load_scene(small_scene), tmp_path / "other", CONFIG)
    assert same_files(whole.newest_checkpoint(), other.folder.newest_checkpoint())
    assert other.facts.scene == str(small_scene.resolve())
    assert load_run(other.folder.path).load_scene().name == small_scene.name


def test_a_scene_keeps_the_resolution_that_it_was_read_with(small_scene, tmp_path):
    run = train(load_scene(small_scene, resolution=20), tmp_path / "run", CONFIG)
    camera = load_run(run.folder.path).load_scene().train[0].camera
    assert (run.config.resolution, camera.width) == (20, 20)


def test_a_run_from_arrays_is_opened_with_its_scene(small_scene, tmp_path):
    scene = from_arrays(small_scene)
    train(scene, tmp_path / "run", CONFIG)
    with pytest.raises(SceneError, match="from arrays"):
        load_run(tmp_path / "run").load_scene()
    assert load_run(tmp_path / "run", scene).load_scene() is scene
    other = Scene.from_arrays(scene.train_cameras[:1], rgb=np.zeros((1, 30, 40, 3)))
    with pytest.raises(RunError, match=r"1 training views of 1 images, not 4 of 8"):
        load_run(tmp_path / "run", other).load_scene()


def test_the_loop_is_the_callers(small_scene, tmp_path):
    seen = []
    for state in train_steps(small_scene, tmp_path / "loop", CONFIG):
        assert repr(state).startswith(f"LiveRun(step {state.step}, loss {state.loss:.4f}, ")
        seen.append((state.step, state.statistics.terms["rgb"], state.gaussian_count))
    logged = []
    whole = train_into(
        small_scene,
        tmp_path / "whole",
        CONFIG,
        hooks=Hooks(on_step=lambda s: logged.append((s.step, s.terms["rgb"], s.gaussians)) is True),
    )
    assert [step for step, _, _ in seen] == [1, 2, 3, 4, 5, 6]
    assert [entry[:2] for entry in seen] == [entry[:2] for entry in logged]
    run = load_run(tmp_path / "loop")
    assert same_files(run.folder.newest_checkpoint(), whole.newest_checkpoint())


def test_leaving_the_loop_keeps_a_checkpoint_to_resume_from(whole, small_scene, tmp_path):
    for state in train_steps(small_scene, tmp_path / "loop", CONFIG):
        if state.step == 2:
            break
    del state
    assert load_run(tmp_path / "loop").facts.step == 2
    steps = [s.step for s in train_steps(small_scene, tmp_path / "loop", CONFIG, resume=True)]
    assert steps == [3, 4, 5, 6]
    newest = load_run(tmp_path / "loop").folder.newest_checkpoint()
    assert same_files(newest, whole.newest_checkpoint())


def test_an_error_in_the_loop_keeps_the_step_and_frees_the_folder(small_scene, tmp_path):
    def loop() -> None:
        for state in train_steps(small_scene, tmp_path / "loop", CONFIG):
            if state.step == 2:
                raise ArithmeticError

    with pytest.raises(ArithmeticError):
        loop()
    gc.collect()
    assert load_run(tmp_path / "loop").facts.step == 2
    train(small_scene, tmp_path / "loop", CONFIG, resume=True)


def test_a_live_run_renders_and_a_snapshot_stays(small_scene):
    scene = load_scene(small_scene)
    camera = scene.eval[0].camera
    loop = train_steps(scene, config=CONFIG)
    state = next(loop)
    snapshot, first = state.snapshot(), state.render(camera)
    torch.testing.assert_close(snapshot.render(camera)[RGB].image, first[RGB].image)
    *_, state = loop
    assert not torch.equal(state.render(camera)[RGB].image, first[RGB].image)
    torch.testing.assert_close(snapshot.render(camera)[RGB].image, first[RGB].image)
    assert (snapshot.facts.step, state.step) == (1, 6)
    assert evaluate_run(snapshot).views


def scores_of(run: RunFolder) -> dict[int, dict[str, float]]:
    """What the log says of the held-out views, by step."""
    lines = map(json.loads, run.log_file.read_text().splitlines())
    return {line["step"]: line for line in lines if "eval_rgb_psnr" in line}


def test_scores_during_a_training_are_those_of_its_checkpoints_and_change_no_bit(
    small_scene, tmp_path
):
    density = replace(CONFIG.densification, start=0, stop=6, every=2)
    config = replace(CONFIG, densification=density, checkpoint_every=2)
    plain = train(small_scene, tmp_path / "plain", config)
    before = torch.get_rng_state()
    scored = train(small_scene, tmp_path / "scored", config, eval_steps=4)
    assert torch.equal(torch.get_rng_state(), before)
    for one, other in zip(plain.folder.checkpoints(), scored.folder.checkpoints(), strict=True):
        assert same_files(one, other)
    assert not scores_of(plain.folder)
    found = scores_of(scored.folder)
    assert found.keys() == {4, 6}
    figures = evaluate_run(scored).mean
    for modality in (RGB, THERMAL):
        for name in ("psnr", "ssim"):
            assert found[6][f"eval_{modality}_{name}"] == figures[modality][name]
    assert found[6]["eval_thermal_mae_c"] == figures[THERMAL]["mae_c"]

    train(small_scene, tmp_path / "parts", config, eval_steps=4, stop_at=4)
    resumed = train(small_scene, tmp_path / "parts", resume=True, eval_steps=4)
    assert scores_of(resumed.folder) == found
    assert same_files(resumed.folder.newest_checkpoint(), plain.folder.newest_checkpoint())


def test_scores_during_a_training_name_the_error_against_the_exact_truth(make_scene, tmp_path):
    scene = make_scene()
    (scene / "truth" / "temperature").mkdir(parents=True)
    for view in load_scene(scene).eval:
        exact = Image.fromarray(np.full((30, 40), 20, np.float32))
        exact.save(scene / "truth" / "temperature" / f"{view.name}.tiff")
    folder = tmp_path / "run"
    states = train_steps(scene, folder, replace(CONFIG, max_steps=2), eval_steps=1)
    assert [state.step for state in states] == [1, 2]
    found = scores_of(RunFolder(folder))
    assert found.keys() == {1, 2}
    truth = evaluate_run(load_run(folder)).truth
    assert truth is not None
    assert found[2]["eval_truth_mae_c"] == truth["mae_c"]


def test_a_held_out_photo_that_cannot_be_read_ends_the_training_with_its_step(
    small_scene, tmp_path
):
    def load() -> Pixels:
        raise SceneError("the photo is gone")

    scene = load_scene(small_scene)
    gone = {each: replace(image, load=load) for each, image in scene.eval[0].images.items()}
    broken = replace(scene, eval=(replace(scene.eval[0], images=gone),))
    with pytest.raises(SceneError, match="gone"):
        train(broken, tmp_path / "run", CONFIG, eval_steps=4)
    assert load_run(tmp_path / "run").facts.step == 4
    resumed = train(small_scene, tmp_path / "run", resume=True)
    whole = train(small_scene, tmp_path / "whole", CONFIG)
    assert same_files(resumed.folder.newest_checkpoint(), whole.folder.newest_checkpoint())


@pytest.mark.parametrize(
    "error", [DeviceError("too many Gaussians"), torch.cuda.OutOfMemoryError("out of memory")]
)
def test_a_training_goes_on_where_there_is_no_memory_to_score(error, whole, small_scene, tmp_path):
    def score(trainer: Trainer) -> NoReturn:
        raise error

    hooks = Hooks(validation=Validation(4, score))
    with pytest.warns(MrgsWarning, match="held-out views were not scored"):
        train_into(small_scene, tmp_path / "run", CONFIG, hooks=hooks)
    found = RunFolder(tmp_path / "run")
    assert same_files(found.newest_checkpoint(), whole.newest_checkpoint())
    assert not scores_of(found)


def test_an_error_in_scoring_that_is_not_of_memory_ends_the_training(small_scene, tmp_path):
    def score(trainer: Trainer) -> NoReturn:
        raise RuntimeError("wrong shape")

    hooks = Hooks(validation=Validation(1, score))
    with pytest.raises(RuntimeError, match="wrong shape"):
        train_into(small_scene, tmp_path / "run", CONFIG, hooks=hooks)


@pytest.mark.parametrize("steps", [0, -3, 2.5])
def test_scores_are_asked_for_by_a_whole_number_of_steps(small_scene, steps):
    with unchecked(), pytest.raises(ConfigError, match="eval_steps") as refused:
        train(small_scene, config=CONFIG, eval_steps=steps)
    assert refused.value.options == ("eval_steps",)


def test_without_held_out_views_there_is_nothing_to_score(small_scene):
    scene = replace(load_scene(small_scene), eval=())
    with pytest.raises(ConfigError, match="holds out no views"):
        train(scene, config=CONFIG, eval_steps=2)


def test_the_callers_default_device_does_not_matter(small_scene, tmp_path):
    """As of a notebook that has set "cuda": what is made without a device stays on the CPU."""
    with torch.device("meta"):
        run = train(small_scene, tmp_path / "run", make_config("mrgs-plus", "fast", max_steps=2))
        metrics = evaluate_run(run)
        spot = run.load_scene().train[0].camera
        assert spot_radius((0.0, 0.0, 0.0), spot, run.load_scene()) > 0
        report_run(run)
    assert metrics.views


def test_progress_is_told_after_each_step(small_scene, tmp_path):
    told = []

    def progress(done: int, total: int) -> None:
        told.append((done, total))

    train(small_scene, tmp_path / "run", CONFIG, stop_at=2, progress=progress)
    train(small_scene, tmp_path / "run", resume=True, progress=progress)
    assert told == [(1, 6), (2, 6), (3, 6), (4, 6), (5, 6), (6, 6)]


class Replacing(Term):
    """Takes the place of L_rgb."""

    name = "rgb"

    def value(self, context: LossContext) -> torch.Tensor:
        return context.observed[RGB].image.mean()


def test_the_runs_folder_names_what_it_was_trained_with_besides_its_configuration(
    whole, small_scene, tmp_path
):
    assert whole.custom_parts == []
    given = {"terms": [Replacing()], "strategy": replace(CONFIG.densification, every=3)}
    train(small_scene, tmp_path / "run", CONFIG, stop_at=2, **given)
    run = train(small_scene, tmp_path / "run", resume=True, **given)
    strategy, term = run.folder.custom_parts
    assert strategy.startswith("strategy: mrgs.method.density.adaptive.AdaptiveDensityControl(")
    assert "every=3" in strategy
    assert term == f"term: rgb: {__name__}.Replacing, in place of the configured one"
    assert load_run(run.folder.path).config == CONFIG
    evaluate_run(run)
    document = json.loads((run.folder.path / "eval" / "metrics.json").read_text())
    assert document["custom_parts"] == [strategy, term]


class MidStep(Term):
    """Does something in the midst of every step."""

    name = "mid_step"
    replayable = False

    def __init__(self, action: Callable[[], None]) -> None:
        self.action = action

    def value(self, context: LossContext) -> None:
        """Nothing is added to the loss."""
        self.action()


def test_another_thread_sees_whole_steps(small_scene, tmp_path):
    """A snapshot and a rendering wait for the end of the step that is under way."""
    found, states = [], []

    def look() -> None:
        found.append((states[-1].snapshot(), states[-1].render(camera)))

    def begin_to_look() -> None:
        if not states or states[-1].step != 2:
            return
        thread.start()
        until = time.monotonic() + 60
        while len(states[-1]._trainer._turns._queue) < 2:
            assert thread.is_alive(), "it did not wait for the step that is under way"
            assert time.monotonic() < until
            time.sleep(0.001)
        assert not found

    camera = load_scene(small_scene).train[0].camera
    thread = Thread(target=look, daemon=True)
    terms = [MidStep(begin_to_look)]
    for state in train_steps(small_scene, tmp_path / "loop", CONFIG, terms=terms):
        states.append(state)
        if state.step == 3:
            thread.join(60)
            ((snapshot, rendering),) = found
            assert snapshot.facts.step == 3
            torch.testing.assert_close(snapshot.render(camera)[RGB].image, rendering[RGB].image)
    assert state.step == 6


def test_a_training_that_has_ended_is_opened_not_snapshot(small_scene, tmp_path):
    *_, state = train_steps(small_scene, tmp_path / "loop", CONFIG)
    train(small_scene, tmp_path / "loop", CONFIG, resume=True)
    with pytest.raises(RunError, match="load_run"):
        state.snapshot()
    camera = load_scene(small_scene).eval[0].camera
    assert RGB in state.render(camera)


def test_warnings_about_the_scene_point_at_the_callers_line(small_scene):
    views = load_scene(small_scene).train
    scene = Scene.from_arrays(
        [view.camera for view in views], rgb=np.zeros((len(views), 30, 40, 3)), eval_every=0
    )
    one_step = replace(CONFIG, max_steps=1)
    with pytest.warns(MrgsWarning, match="black") as of_train:
        train(scene, config=one_step)
    with pytest.warns(MrgsWarning, match="black") as of_steps:
        next(train_steps(scene, config=one_step))
    assert {warning.filename for warning in (*of_train, *of_steps)} == {__file__}


def test_an_existing_run_is_not_overwritten(whole, small_scene):
    with pytest.raises(RunError, match="already holds"):
        next(train_steps(small_scene, whole.path, CONFIG))


def test_a_temporary_run_that_is_stopped_is_kept_and_named(small_scene):
    def stop(statistics):
        if statistics.step == 3:
            raise KeyboardInterrupt

    with (
        pytest.warns(MrgsWarning, match="kept in") as warned,
        pytest.raises(KeyboardInterrupt),
    ):
        train(small_scene, config=CONFIG, on_step=stop)
    gc.collect()
    kept = re.findall(r"kept in (\S+)", str(warned[0].message))[0]
    assert load_run(kept).facts.step == 3
    assert train(small_scene, kept, resume=True).facts.step == 6
    shutil.rmtree(kept)


PROGRAM = """
import os, sys
from mrgs import load_run, make_config, train, train_steps
from mrgs.errors import MrgsError

scene, folder = sys.argv[1:]
config = make_config("mrgs", "fast", max_steps=6, max_gaussians=60)

def in_a_fork(compute):
    if not hasattr(os, "fork"):
        return
    child = os.fork()
    if child == 0:
        try:
            compute()
            print("computed", flush=True)
        except MrgsError as error:
            print("refused" if "'spawn'" in str(error) else error, flush=True)
        os._exit(0)
    os.waitpid(child, 0)

try:
    train(folder + "/nothing", config=config)
except MrgsError:
    print("no scene", flush=True)
in_a_fork(lambda: train(scene, folder + "/forked", config, stop_at=1))
run = train(scene, folder + "/run", config, stop_at=1)
camera = run.load_scene().train[0].camera
loop = train_steps(scene, folder + "/open", config)
next(loop)
state = next(loop)
in_a_fork(lambda: run.render(camera))
in_a_fork(lambda: state.render(camera))
in_a_fork(lambda: state.snapshot())
in_a_fork(lambda: load_run(folder + "/run"))
in_a_fork(lambda: train(scene, folder + "/again", config))
"""


class Ended(NamedTuple):
    """A process that ran the program, and the folder with its runs."""

    process: subprocess.CompletedProcess[str]
    folder: Path


@pytest.fixture(scope="module")
def ended(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """A process of its own takes seconds to start."""
    folder = tmp_path_factory.mktemp("process")
    command = [sys.executable, "-c", PROGRAM, str(small_scene), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1_200, check=False)
    return Ended(done, folder)


@pytest.mark.slow
def test_a_loop_that_is_open_when_the_process_ends_keeps_its_step(ended):
    assert (ended.process.returncode, ended.process.stderr) == (0, "")
    assert load_run(ended.folder / "open").facts.step == 2


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no forks")
def test_a_fork_says_so_only_if_something_was_computed_before_it(ended):
    found = ended.process.stdout.splitlines()
    assert found == ["no scene", "computed", *["refused"] * 5], ended.process.stderr


@pytest.mark.filterwarnings("ignore:.*no temperatures")
def test_what_was_never_photographed_is_not_rendered(make_scene):
    scene = load_scene(make_scene(thermal=False))
    camera = scene.train[0].camera
    loop = train_steps(scene, config=CONFIG)
    state = next(loop)
    run = state.snapshot()
    assert run.modalities == tuple(run.render(camera)) == tuple(state.render(camera)) == (RGB,)
    for shows in (run, state):
        with pytest.raises(ValueError, match=r"thermal .* only rgb"):
            shows.render({THERMAL: camera})
        with pytest.raises(ValueError, match="empty"):
            shows.render({})
    with pytest.raises(ValueError, match="no thermal photos"):
        run.temperature_at(np.zeros((1, 3)))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"stop_at": 0}, ConfigError, "at least 1"),
        ({"stop_at": "3"}, ConfigError, "stop_at .* '3'"),
        ({"output": CONFIG}, RunError, "not TrainConfig"),
        ({"config": "mrgs-plus"}, ConfigError, "make_config"),
        ({"scene": []}, SceneError, "not list"),
    ],
)
def test_what_is_no_parameter_of_train_is_named(arguments, error, message, small_scene):
    with pytest.raises(error, match=message):
        train(**({"scene": small_scene, "config": CONFIG} | arguments))
