from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numba
import pytest
import torch
from safetensors.torch import load_file

from mrgs.errors import RunError, SceneError, TrainingError
from mrgs.evaluation import evaluate_run, render_run
from mrgs.run_files.checkpoint import load_facts, write_file
from mrgs.run_files.folder import RunFolder
from mrgs.runs.open import load_run, open_run
from mrgs.scene import RGB, THERMAL
from mrgs.training import make_config, train
from mrgs.training.start import Hooks, TrainOptions
from mrgs_thermonerf import ThermoNerfRun, train_thermonerf
from mrgs_thermonerf import run as run_module
from tests.helpers.scenes import write_scene
from tests.helpers.thermonerf import small_config


@pytest.fixture(scope="module")
def trained(small_scene, tmp_path_factory):
    """Three steps; only to be read."""
    output = tmp_path_factory.mktemp("runs") / "run"
    return train_thermonerf(small_scene, output, small_config(3)).path


@pytest.fixture
def folder(trained, tmp_path):
    """A copy of the trained run, to be damaged."""
    return RunFolder(shutil.copytree(trained, tmp_path / "run"))


def spoil(monkeypatch, steps):
    """Make the loss of some steps NaN."""
    honest = run_module.distortion_loss
    calls = iter(range(1, 1_000))
    monkeypatch.setattr(
        run_module,
        "distortion_loss",
        lambda *args: honest(*args) * (torch.nan if next(calls) in steps else 1.0),
    )


def test_training_lowers_the_loss_of_both_modalities(small_scene, tmp_path):
    seen = []
    train_thermonerf(
        small_scene,
        tmp_path / "run",
        small_config(35, rays_per_batch=128),
        hooks=Hooks(on_step=lambda s: seen.append(s.terms)),
    )
    for name, factor in (("rgb", 0.5), ("thermal", 0.5)):
        first, last = (sum(terms[name] for terms in part) / 10 for part in (seen[:10], seen[-10:]))
        assert last < factor * first


def test_the_folder_holds_what_every_run_has(small_scene, tmp_path):
    folder = train_thermonerf(small_scene, tmp_path / "run", small_config(10, checkpoint_every=3))
    assert "method: thermonerf" in folder.config_file.read_text()
    assert [path.name for path in folder.checkpoints()] == [
        "step_000009.safetensors",
        "step_000010.safetensors",
    ]
    entries = [json.loads(line) for line in folder.log_file.read_text().splitlines()]
    assert [entry["step"] for entry in entries] == [10]
    assert {"loss", "loss_rgb", "loss_thermal", "thermal_error_c", "seconds"} <= set(entries[0])
    facts = load_facts(folder.newest_checkpoint())
    assert facts.step == 10
    assert facts.train_seconds > 0


def test_a_resumed_run_has_the_same_bits(small_scene, tmp_path):
    config = small_config(8)
    whole = train_thermonerf(small_scene, tmp_path / "whole", config)
    parted = train_thermonerf(small_scene, tmp_path / "parted", config, stop_at=5)
    assert load_facts(parted.newest_checkpoint()).step == 5
    train_thermonerf(
        small_scene, parted.path, replace(config, max_steps=99), options=TrainOptions(resume=True)
    )
    expected, found = load_file(whole.newest_checkpoint()), load_file(parted.newest_checkpoint())
    assert set(expected) == set(found)
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert parted.log_file.read_text().count("\n") == whole.log_file.read_text().count("\n")


@pytest.mark.slow
def test_the_number_of_threads_does_not_change_the_bits(small_scene, tmp_path):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("the machine has one core")
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        numba.set_num_threads(threads)
        folder = train_thermonerf(
            small_scene, tmp_path / f"{threads}", small_config(6, rays_per_batch=1024)
        )
        results.append(load_file(folder.newest_checkpoint()))
    torch.set_num_threads(1)
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:scene. No view has any")
@pytest.mark.parametrize("options", [{"two_cameras": True}, {"rgb": False}, {"thermal": False}])
def test_other_kinds_of_scenes_train_too(tmp_path, options):
    folder = train_thermonerf(
        write_scene(tmp_path / "scene", **options), tmp_path / "run", small_config(3)
    )
    run = open_run(folder.path)
    rendering = run.render_view(run.load_scene().eval[0])
    assert (RGB not in rendering) == (options.get("rgb") is False)
    assert (THERMAL not in rendering) == (options.get("thermal") is False)


def test_a_run_is_opened_scored_and_rendered(folder):
    run = open_run(folder.path)
    assert isinstance(run, ThermoNerfRun)
    evaluate_run(run)
    document = json.loads((folder.path / "eval/metrics.json").read_text())
    assert (document["method"], document["steps"], document["gaussians"]) == ("thermonerf", 3, None)
    assert "no Gaussians" in document["reasons"]["gaussians"]
    assert document["mean"]["thermal"]["psnr"] > 0
    rendered = render_run(run, "eval")
    assert len(list((rendered / "temperature_c").iterdir())) == 2


def test_what_needs_gaussians_refuses(folder):
    with pytest.raises(RunError) as caught:
        load_run(folder.path)
    text = str(caught.value)
    assert text.startswith(str(folder.path))
    assert "thermonerf" in text
    assert "`mrgs eval`" in text
    assert "`mrgs render`" in text


def test_a_run_with_gaussians_is_opened_as_ever_and_not_resumed_here(small_scene, tmp_path):
    folder = train(
        small_scene, tmp_path / "run", make_config("mrgs", max_steps=1, max_gaussians=50)
    )
    assert open_run(folder.path).gaussian_count == len(load_run(folder.path).model.gaussians)
    with pytest.raises(RunError, match=r"of mrgs, .*thermonerf"):
        train_thermonerf(
            small_scene, folder.path, small_config(), options=TrainOptions(resume=True)
        )


def test_a_run_is_never_overwritten(small_scene, folder):
    with pytest.raises(RunError, match="resume it"):
        train_thermonerf(small_scene, folder.path, small_config(1))


def test_a_run_that_died_before_its_first_checkpoint_is_begun_anew(small_scene, folder):
    folder.newest_checkpoint().unlink()
    again = train_thermonerf(small_scene, folder.path, small_config(2))
    assert load_facts(again.newest_checkpoint()).step == 2


def test_somebody_elses_configuration_is_kept(small_scene, tmp_path):
    (tmp_path / "config.yaml").write_text("theme: dark\n")
    with pytest.raises(RunError, match=r"config\.yaml .*not a"):
        train_thermonerf(small_scene, tmp_path, small_config(1))


def test_a_damaged_checkpoint_or_configuration_is_named(folder):
    text = folder.config_file.read_text()
    folder.config_file.write_text(text + "colour: red\n")
    with pytest.raises(RunError, match=r"'colour'.*; fix"):
        open_run(folder.path)
    folder.config_file.write_text(text)
    path = folder.newest_checkpoint()
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(RunError, match="no checkpoint"):
        open_run(folder.path)


def test_a_checkpoint_without_a_frame_does_not_fit(folder):
    path = folder.newest_checkpoint()
    header = {**load_facts(path).to_json(), "skipped_in_a_row": 0}
    write_file(path, {"frame.sizes": torch.zeros(4), "frame.centre": torch.zeros(3)}, header)
    with pytest.raises(RunError, match="does not fit"):
        open_run(path.parents[1])


def test_three_skipped_steps_in_a_row_end_the_run(small_scene, tmp_path, monkeypatch):
    spoil(monkeypatch, {2, 4, 5, 6})
    with pytest.raises(TrainingError) as caught:
        train_thermonerf(small_scene, tmp_path / "run", small_config(20, checkpoint_every=3))
    kept = tmp_path / "run/checkpoints/step_000003.safetensors"
    assert "at step 6;" in str(caught.value)
    assert str(kept) in str(caught.value)
    assert all(tensor.isfinite().all() for tensor in load_file(kept).values())
    assert load_facts(kept).skipped_steps == 1


def test_stopping_leaves_a_checkpoint(small_scene, tmp_path):
    folder = train_thermonerf(
        small_scene, tmp_path / "run", small_config(20), hooks=Hooks(on_step=lambda s: s.step == 4)
    )
    assert load_facts(folder.newest_checkpoint()).step == 4


def test_a_scene_that_cannot_be_read_leaves_no_run(tmp_path):
    with pytest.raises(SceneError, match="nowhere"):
        train_thermonerf(tmp_path / "nowhere", tmp_path / "run", small_config())
    assert list(tmp_path.iterdir()) == []


def test_training_leaves_the_callers_random_numbers_alone(small_scene, tmp_path):
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    train_thermonerf(small_scene, tmp_path / "run", small_config(2))
    assert torch.equal(torch.rand(4), expected)


def test_an_interrupt_before_the_first_checkpoint_leaves_no_run(small_scene, tmp_path):
    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_thermonerf(
            small_scene, tmp_path / "run", small_config(), hooks=Hooks(on_start=interrupt)
        )
    assert not RunFolder(tmp_path / "run").path.exists()
