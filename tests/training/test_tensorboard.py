"""The log for TensorBoard says what log.jsonl says."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

import mrgs
from mrgs.errors import ConfigError
from mrgs.run_files.folder import TENSORBOARD
from mrgs.training import make_config, train
from mrgs.training.start import TrainOptions

CONFIG = make_config("mrgs", "fast", max_steps=20, max_gaussians=60)


def scalars_of(run: Path) -> dict[str, dict[int, float]]:
    """By name and step."""
    module = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = module.EventAccumulator(str(run / TENSORBOARD)).Reload()
    return {
        name: {event.step: event.value for event in events.Scalars(name)}
        for name in events.Tags()["scalars"]
    }


def test_every_number_of_the_log_is_a_scalar_also_after_resuming(small_scene, tmp_path):
    pytest.importorskip("tensorboard")
    folder = train(
        small_scene, tmp_path, CONFIG, options=TrainOptions(tensorboard=True), stop_at=10
    )
    train(small_scene, tmp_path, CONFIG, options=TrainOptions(tensorboard=True, resume=True))
    lines = [json.loads(line) for line in folder.log_file.read_text().splitlines()]
    scalars = scalars_of(tmp_path)
    assert {"loss", "loss/rgb", "loss/thermal", "thermal_error_c", "gaussians"} <= scalars.keys()
    for name in ("loss", "loss_rgb", "seconds"):
        logged = {line["step"]: line[name] for line in lines if name in line}
        assert logged.keys() == {10, 20}
        assert scalars[name.replace("loss_", "loss/")] == pytest.approx(logged, rel=1e-6)


def test_held_out_views_are_curves_and_pictures(small_scene, tmp_path):
    module = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    run = mrgs.train(small_scene, tmp_path, CONFIG, tensorboard=True, eval_steps=10)
    assert scalars_of(tmp_path)["eval/thermal_psnr"].keys() == {10, 20}
    events = module.EventAccumulator(str(tmp_path / TENSORBOARD)).Reload()
    names = {f"eval/{each}_{view.name}" for view in run.load_scene().eval for each in view.images}
    assert set(events.Tags()["images"]) == names
    for name in names:
        first, second = events.Images(name)
        assert (first.step, second.step, first.width, first.height) == (10, 20, 80, 30)


def test_without_it_nothing_is_written(small_scene, tmp_path):
    train(small_scene, tmp_path, CONFIG, stop_at=10)
    assert not (tmp_path / TENSORBOARD).exists()


def test_what_is_missing_is_said_with_the_remedy(small_scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ConfigError, match=r"pip install 'mrgs\[tensorboard\]'"):
        train(small_scene, tmp_path / "run", CONFIG, options=TrainOptions(tensorboard=True))
