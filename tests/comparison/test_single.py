from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from mrgs.comparison.methods import Variant, configure
from mrgs.comparison.single import is_scored, require_same_config, run_one, run_scores
from mrgs.errors import ConfigError
from mrgs.training import make_config, train
from mrgs.training.run_folder import RunFolder
from tests.helpers.comparison import tiny_options


def test_a_run_is_trained_and_scored_then_left_alone(small_scene, tmp_path):
    config = configure(Variant("3dgs-rgbt", "3dgs-rgbt"), tiny_options(), 0)
    assert not is_scored(run_scores(tmp_path / "run"), tmp_path / "run", config, with_lpips=False)
    scored = []
    assert run_one(
        small_scene,
        tmp_path / "run",
        config,
        on_score=lambda done, total: scored.append((done, total)),
    )
    assert scored == [(1, 2), (2, 2)]
    assert is_scored(run_scores(tmp_path / "run"), tmp_path / "run", config, with_lpips=False)
    assert not is_scored(run_scores(tmp_path / "run"), tmp_path / "run", config, with_lpips=True)
    steps = []
    assert run_one(small_scene, tmp_path / "run", config, on_step=steps.append)
    assert steps == []


def test_a_run_that_was_stopped_goes_on_to_the_same_bits(small_scene, tmp_path):
    config = configure(Variant("3dgs-rgbt", "3dgs-rgbt"), tiny_options(), 0)
    assert not run_one(
        small_scene, tmp_path / "cut", config, on_step=lambda statistics: statistics.step == 2
    )
    assert not (tmp_path / "cut" / "eval").exists()
    steps = []
    assert run_one(
        small_scene,
        tmp_path / "cut",
        config,
        on_step=lambda statistics: steps.append(statistics.step),
    )
    assert steps == [3]
    assert run_one(small_scene, tmp_path / "whole", config)
    means = [
        json.loads((tmp_path / name / "eval" / "metrics.json").read_text())["mean"]
        for name in ("cut", "whole")
    ]
    assert means[0] == means[1]


def test_scores_of_an_earlier_step_do_not_count(small_scene, tmp_path):
    config = configure(Variant("3dgs-rgbt", "3dgs-rgbt"), tiny_options(), 0)
    run_one(small_scene, tmp_path, config)
    path = tmp_path / "eval" / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"steps": 2}))
    assert not is_scored(run_scores(tmp_path), tmp_path, config, with_lpips=False)
    path.write_text("{")
    assert not is_scored(run_scores(tmp_path), tmp_path, config, with_lpips=False)


@pytest.mark.parametrize("group", ["thermal", "rgb"])
def test_scores_that_lack_a_figure_are_renewed_without_training(group, small_scene, tmp_path):
    config = configure(Variant("3dgs-rgbt", "3dgs-rgbt"), tiny_options(), 0)
    run_one(small_scene, tmp_path, config)
    path = tmp_path / "eval" / "metrics.json"
    whole = path.read_text()
    older = json.loads(whole)
    del older["mean"][group]["psnr_matched"]
    path.write_text(json.dumps(older))
    assert not is_scored(run_scores(tmp_path), tmp_path, config, with_lpips=False)
    steps = []
    assert run_one(small_scene, tmp_path, config, on_step=steps.append)
    assert (steps, path.read_text()) == ([], whole)
    assert is_scored(run_scores(tmp_path), tmp_path, config, with_lpips=False)


def test_scores_that_lack_a_figure_count_where_the_checkpoint_is_gone(small_scene, tmp_path):
    config = configure(Variant("3dgs-rgbt", "3dgs-rgbt"), tiny_options(), 0)
    run_one(small_scene, tmp_path, config)
    (tmp_path / "eval" / "metrics.json").write_text(
        json.dumps({"steps": 3, "mean": {"thermal": {"psnr": 30.0}}})
    )
    assert not is_scored(run_scores(tmp_path), tmp_path, config, with_lpips=False)
    shutil.rmtree(tmp_path / "checkpoints")
    assert is_scored(run_scores(tmp_path), tmp_path, config, with_lpips=False)
    assert not is_scored(run_scores(tmp_path), tmp_path, config, with_lpips=True)


def test_another_configuration_in_the_folder_is_named(small_scene, tmp_path):
    config = make_config("mrgs", "fast", max_steps=3, max_gaussians=60)
    require_same_config(tmp_path / "nothing there", config, None)
    train(small_scene, tmp_path / "run", config)
    require_same_config(tmp_path / "run", config, None)
    other = make_config("mrgs", "fast", max_steps=3, max_gaussians=70)
    with pytest.raises(ConfigError, match=r"densification\.max_gaussians is 60"):
        require_same_config(tmp_path / "run", other, None)


def test_a_folder_that_died_before_its_first_checkpoint_may_change_its_mind(tmp_path: Path):
    RunFolder(tmp_path).start(make_config("mrgs", max_steps=3))
    require_same_config(tmp_path, make_config("mrgs", max_steps=4), None)
