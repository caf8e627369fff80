"""One run: trained, scored, and compared with its scene after changes to that."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image, ImageOps

from mrgs.data import load_scene
from mrgs.errors import ConfigError
from mrgs.run_files.folder import RunFolder
from mrgs.scene import RGB
from mrgs.training import make_config, train
from mrgs_compare.plan import (
    SceneData,
    Variant,
    configure,
    is_scored,
    require_same_config,
    require_same_data,
    run_one,
    run_scores,
)
from tests.helpers.comparison import tiny_options
from tests.helpers.runs import made_once

Change = Callable[[Path], None]


@pytest.fixture
def scene(small_scene: Path, tmp_path: Path) -> Path:
    return shutil.copytree(small_scene, tmp_path / "balls")


@pytest.fixture
def folder(small_scene: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = configure(Variant("3dgs-rgbt", "3dgs-rgbt"), tiny_options(), 0)

    def write(path: Path) -> Path:
        run_one(small_scene, path, config)
        return path

    return shutil.copytree(made_once(tmp_path_factory, "scored", write), tmp_path / "run")


def change_photo(scene: Path, pattern: str) -> None:
    path = min((scene / "images").glob(pattern))
    with Image.open(path) as image:
        changed = ImageOps.mirror(image)
    changed.save(path)


def train_photo(scene: Path) -> None:
    change_photo(scene, "*train*")


def held_out_photo(scene: Path) -> None:
    change_photo(scene, "*eval*")


def change_transforms(scene: Path, name: str) -> None:
    """Move the camera of the first frame of that kind a little."""
    path = scene / "transforms.json"
    content = json.loads(path.read_text())
    frame = next(each for each in content["frames"] if name in each["file_path"])
    frame["transform_matrix"][0][3] += 0.01
    path.write_text(json.dumps(content))


def train_pose(scene: Path) -> None:
    change_transforms(scene, "train")


def held_out_pose(scene: Path) -> None:
    change_transforms(scene, "eval")


def temperature_range(scene: Path) -> None:
    path = scene / "temperature_bounds.json"
    bounds = json.loads(path.read_text())
    path.write_text(json.dumps(bounds | {"absolute_max_temperature": 99.0}))


def data_of(scene: Path) -> SceneData:
    return SceneData(load_scene(scene))


def test_a_copy_of_the_scene_is_the_same(scene, folder):
    data = data_of(scene)
    require_same_data(folder, data, run_scores(folder))
    assert not data.changed_since(run_scores(folder))
    shutil.rmtree(folder / "checkpoints")
    require_same_data(folder, data, run_scores(folder))


def test_a_folder_without_a_run_is_of_any_scene(scene, tmp_path):
    data = data_of(scene)
    require_same_data(tmp_path / "none", data, run_scores(tmp_path / "none"))
    assert not data.changed_since(run_scores(tmp_path / "none"))
    assert vars(data).keys() == {"scene"}  # no photo was read


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (train_photo, r"photos .*\(rgb\)"),
        (train_pose, r"poses .*\(thermal\)"),
        (temperature_range, "temperature range"),
    ],
)
@pytest.mark.parametrize("is_scored", [True, False])
def test_other_data_for_training_are_named(change: Change, named, is_scored, scene, folder):
    change(scene)
    if not is_scored:
        shutil.rmtree(folder / "eval")
    with pytest.raises(ConfigError, match=rf"balls .*{named}") as caught:
        require_same_data(folder, data_of(scene), run_scores(folder))
    assert caught.value.options == ("output",)


@pytest.mark.parametrize("change", [held_out_photo, held_out_pose])
def test_other_held_out_images_make_the_scores_stale(change: Change, scene, folder):
    change(scene)
    data = data_of(scene)
    require_same_data(folder, data, run_scores(folder))
    assert data.changed_since(run_scores(folder))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (train_photo, "training photos"),
        (held_out_photo, r"photos .*\(rgb\)"),
        (held_out_pose, r"poses .*\(thermal\)"),
        (temperature_range, "temperature range"),
    ],
)
def test_scores_without_a_checkpoint_are_of_the_same_data(change: Change, named, scene, folder):
    change(scene)
    shutil.rmtree(folder / "checkpoints")
    with pytest.raises(ConfigError, match=rf"balls .*{named}"):
        require_same_data(folder, data_of(scene), run_scores(folder))


def test_images_of_another_modality_are_named(scene, folder, near_infrared):
    loaded = load_scene(scene)
    view, *others = loaded.train
    more = replace(view, images={**view.images, near_infrared: view.images[RGB]})
    changed = replace(loaded, train=(more, *others))
    with pytest.raises(ConfigError, match=rf"images .*\({near_infrared.name}\)"):
        require_same_data(folder, SceneData(changed), run_scores(folder))


def test_a_checkpoint_that_is_damaged_is_no_reason_to_refuse(scene, folder):
    for path in RunFolder(folder).checkpoints():
        path.write_bytes(path.read_bytes()[:100])
    require_same_data(folder, data_of(scene), run_scores(folder))


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


@pytest.mark.slow
@pytest.mark.parametrize("method", ["3dgs-rgbt", "thermonerf"])
def test_every_method_is_trained_continued_and_read_back(method, small_scene, tmp_path):
    config = configure(Variant(method, method), tiny_options(), 0)
    assert not run_one(small_scene, tmp_path, config, on_step=lambda step: step.step == 2)
    steps = []
    assert run_one(small_scene, tmp_path, config, on_step=lambda step: steps.append(step.step))
    assert steps == [3]
    require_same_config(tmp_path, config, run_scores(tmp_path))
