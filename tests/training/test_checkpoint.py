from __future__ import annotations

import json
import os
import shutil
from copy import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from mrgs.data import load_scene
from mrgs.errors import DamagedCheckpointError, RunError
from mrgs.method.config import TrainConfig
from mrgs.method.losses.term import SceneScale
from mrgs.rasterizer.contract import Dilation
from mrgs.run_files.checkpoint import first_not_finite, load_facts, read
from mrgs.run_files.facts import CheckpointFacts
from mrgs.scene import TemperatureRange
from mrgs.scene.capture import Capture, Viewpoint
from mrgs.training import step
from mrgs.training.checkpoint import load_model, load_state, save
from mrgs.training.state import TrainingState, initial_state
from mrgs.training.view_pass import PhotographedView
from tests.helpers.checkpoints import header_of, rewrite
from tests.helpers.training import short_config, tensors_of

VIEWPOINT = Viewpoint((0.0, 0.5, -1.25), (0.0, 0.0, 1.0))
FACTS = CheckpointFacts(
    step=2,
    scene="/somewhere/balls",
    capture=Capture(
        thermal_viewpoints=(VIEWPOINT,) * 5 + (None,),
        extent=3.25,
        has_celsius=True,
    ),
    temperature=TemperatureRange(10.0, 30.0),
    train_seconds=1.5,
    peak_memory_bytes=1_000,
    skipped_steps=4,
)


@pytest.fixture(scope="module")
def config() -> TrainConfig:
    return short_config()


@pytest.fixture(scope="module")
def state(small_scene, config) -> TrainingState:
    """After two steps; only to be read."""
    scene = load_scene(small_scene)
    state = initial_state(scene, config)
    for _ in range(2):
        (number,) = state.sampler.next()
        view = scene.train[number]
        photos = {each: image.load() for each, image in view.images.items()}
        scale = SceneScale(scene.extent, scene.temperature)
        result = step.training_step(state, [PhotographedView(number, view, photos)], config, scale)
        step.control_density(state, result, config, scene.extent)
    return state


@pytest.fixture(scope="module")
def saved(tmp_path_factory, state) -> Path:
    """A checkpoint of the state; only to be read."""
    path = tmp_path_factory.mktemp("saved") / "checkpoints" / "step_000002.safetensors"
    save(path, state, FACTS)
    return path


@pytest.fixture
def path(tmp_path, saved) -> Path:
    """A copy of the checkpoint, to be damaged."""
    return shutil.copytree(saved.parent, tmp_path / "checkpoints") / saved.name


def test_everything_comes_back(state, path, config):
    state = copy(state)
    state.skipped_in_a_row = state.skipped_in_a_row + 2
    save(path, state, FACTS)
    found, facts = load_state(path, config), load_facts(path)
    assert facts == FACTS
    assert load_facts(path) == FACTS
    expected, tensors = tensors_of(state), tensors_of(found)
    assert set(tensors) == set(expected)
    assert [name for name in expected if not torch.equal(tensors[name], expected[name])] == []
    assert (found.step, found.skipped_in_a_row) == (2, 2)
    assert torch.equal(found.model.neighbours, state.model.neighbours)
    assert torch.equal(found.sampler.state(), state.sampler.state())
    assert torch.equal(found.generator.get_state(), state.generator.get_state())
    assert found.gaussian_optimizer.gaussians is found.model.gaussians


def test_the_model_comes_back(state, path, config):
    model, facts, _ = load_model(path, replace(config, sh_every=1))
    assert facts == FACTS
    assert model.sh_degree == 2
    for name, tensor in state.model.gaussians.tensors().items():
        assert torch.equal(model.gaussians.tensors()[name], tensor)


@pytest.mark.parametrize("angular", [False, True])
def test_a_model_is_drawn_as_it_was_trained(make_start, config, path, angular):
    config = replace(config, dilation_px2=0.1, angular_dilation=angular)
    scene, state = make_start(config)
    save(path, state, FACTS._replace(capture=Capture.of(scene)))
    loaded = load_model(path, config)[0]
    finest = max(camera.focal_px for view in scene.train for camera in view.cameras.values())
    expected = Dilation(0.1, finest if angular else None)
    assert loaded.dilation == state.model.dilation == expected


def test_only_what_is_needed_is_kept_but_all_is_checked(state, path):
    tensors, _, _ = read(path, lambda name: name == "gaussians.means")
    assert list(tensors) == ["gaussians.means"]
    assert torch.equal(tensors["gaussians.means"], state.model.gaussians.means)
    content = bytearray(path.read_bytes())
    found = content.index(tensors_of(state)["gaussians.adam.means.exp_avg"].numpy().tobytes())
    content[found] ^= 1
    path.write_bytes(content)
    with pytest.raises(DamagedCheckpointError, match="digest"):
        read(path, lambda name: name == "gaussians.means")


def test_no_known_temperatures_stay_unknown(state, path):
    save(path, state, FACTS._replace(temperature=None))
    assert load_facts(path).temperature is None


@pytest.mark.parametrize("keep", [0, 7, 500, -1])
def test_a_truncated_checkpoint_is_named(keep, path, config):
    path.write_bytes(path.read_bytes()[:keep])
    for load in (
        load_facts,
        lambda path: load_model(path, config),
        lambda path: load_state(path, config),
    ):
        with pytest.raises(DamagedCheckpointError, match="parsed") as caught:
            load(path)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "header",
    [{}, {"mrgs": "[1]"}, {"mrgs": "{"}, {"other": "1"}],
)
def test_a_file_of_something_else_is_named(header, path):
    save_file({"a": torch.zeros(2)}, path, header)
    with pytest.raises(RunError, match="not a whole"):
        load_facts(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"capture": "removed"},
        {"capture": {"views": 6}},
        {"temperature": [30.0, 10.0]},
        {"temperature": [1.0]},
        {"modalities": "removed"},
        {"modalities": ["nir"]},
        {"modalities": [{"name": "nir", "channels": "1"}]},
        {"modalities": [{"name": "../nir", "channels": 1}]},
        {"step": "2"},
        {"step": -1},
        {"step": True},
        {"train_seconds": float("nan")},
        {"images": [["digest", [1.0], [1.0]]]},
    ],
)
def test_a_header_that_lacks_facts_is_named(changes, path):
    rewrite(path, **changes)
    with pytest.raises(RunError, match="not a whole"):
        load_facts(path)


@pytest.mark.parametrize(
    "modalities",
    [[{"name": "nir", "channels": 1}], [{"name": "thermal", "channels": 3}]],
)
def test_modalities_that_the_tensors_have_not_are_named(modalities, path, config):
    rewrite(path, modalities=modalities)
    with pytest.raises(RunError, match=r"fit .*config\.yaml"):
        load_model(path, config)


@pytest.mark.parametrize("missing", ["sh_dc.rgb", "sh_rest.rgb", "opacity_logit.rgb"])
def test_a_missing_modality_is_named(missing, path, config):
    tensors = load_file(path)
    del tensors[f"gaussians.{missing}"]
    rewrite(path, tensors)
    with pytest.raises(RunError, match=r"fit .*config\.yaml"):
        load_model(path, config)


def test_another_format_is_named(path):
    header = {**header_of(path), "format": 99}
    save_file(load_file(path), path, {"mrgs": json.dumps(header)})
    with pytest.raises(RunError, match="format 99") as caught:
        load_facts(path)
    assert str(path) in str(caught.value)
    assert not isinstance(caught.value, DamagedCheckpointError)


def test_a_header_of_this_format_without_its_digest_is_damaged(path):
    save_file(load_file(path), path, {"mrgs": json.dumps(header_of(path))})
    with pytest.raises(DamagedCheckpointError, match="no digest"):
        load_facts(path)


def test_the_same_numbers_in_another_shape_are_damaged(path):
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    tensors["gaussians.quats"] = tensors["gaussians.quats"].reshape(-1, 2).contiguous()
    save_file(tensors, path, metadata)
    with pytest.raises(DamagedCheckpointError, match="tensors do"):
        read(path)


def test_large_numbers_whose_sum_is_infinite_are_finite():
    large = torch.full((10,), 3e38)
    assert not large.sum().isfinite()
    assert first_not_finite({"a": large, "b": torch.ones(3, dtype=torch.int64)}) is None
    large[4] = float("inf")
    assert first_not_finite({"b": torch.ones(3), "a": large}) == "a"


@pytest.mark.parametrize("number", [-1, 25])
def test_neighbours_that_do_not_exist_are_named(path, config, number):
    tensors = load_file(path)
    assert len(tensors["neighbours"]) == 25
    tensors["neighbours"][3, 0] = number
    rewrite(path, tensors)
    with pytest.raises(RunError, match="neighbours"):
        load_model(path, config)


@pytest.mark.parametrize("count", [-1, "1", True, None])
def test_a_count_of_skipped_steps_that_cannot_be_is_named(path, config, count):
    rewrite(path, skipped_in_a_row=count)
    with pytest.raises(RunError, match="skipped_in_a_row"):
        load_state(path, config)


def test_another_configuration_is_named(path, config):
    other = replace(config, field=replace(config.field, hidden_width=2 * config.field.hidden_width))
    for load in (load_model, lambda path, config: load_state(path, config)):
        with pytest.raises(RunError, match=r"config\.yaml .*bias .*\[64\] .*\[128\]") as caught:
            load(path, other)
        assert str(path) in str(caught.value)


def test_missing_tensors_are_named(path, config):
    tensors = load_file(path)
    del tensors["gaussians.quats"]
    rewrite(path, tensors)
    with pytest.raises(RunError, match="quats is missing"):
        load_model(path, config)


def test_temperatures_of_another_degree_are_named(path, config):
    load_model(path, replace(config, temperature_sh_degree=None))
    with pytest.raises(RunError, match=r"fit .*config\.yaml"):
        load_model(path, replace(config, temperature_sh_degree=3))


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_behind(state, path, monkeypatch):
    before = path.read_bytes()

    def full(*args) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(RunError, match="No space left") as caught:
            save(path, state, FACTS._replace(step=3))
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_one_zoomed_photo_does_not_make_the_photos_finer(make_start, config):
    scene, _ = make_start(config)
    first, *others = scene.train
    zoomed = {
        modality: replace(image, camera=image.camera.with_width(10 * image.camera.width))
        for modality, image in first.images.items()
    }
    finest = Capture.of(scene).finest_focal_px
    changed = replace(scene, train=(replace(first, images=zoomed), *others))
    assert Capture.of(changed).finest_focal_px == finest
