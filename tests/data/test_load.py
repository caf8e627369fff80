from __future__ import annotations

import os
import pickle

import pytest
import torch

from mrgs.data import load_scene
from mrgs.data.load import _unique_names
from mrgs.errors import ConfigError, SceneError
from mrgs.scene import RGB, THERMAL


def test_a_missing_folder(tmp_path):
    with pytest.raises(SceneError, match="nowhere: not"):
        load_scene(tmp_path / "nowhere")


def test_a_folder_that_may_not_be_listed(writer, monkeypatch):
    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    writer.transforms(writer.thermoscenes())
    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(SceneError, match=r"images: .*Permission denied"):
        load_scene(writer.root)


def test_an_unknown_layout_lists_what_was_looked_for(tmp_path):
    with pytest.raises(SceneError, match=r"transforms\.json.*sparse/0/cameras\.bin"):
        load_scene(str(tmp_path))


@pytest.mark.parametrize("resolution", [0, -3])
def test_the_resolution_must_be_positive(writer, resolution):
    with pytest.raises(ConfigError, match="at least 1"):
        load_scene(writer.root, resolution=resolution)


def test_a_resolution_above_the_images_width_changes_nothing(writer):
    writer.transforms(writer.thermoscenes())
    assert load_scene(writer.root, resolution=100).train[0].images[RGB].camera.width == 24


def test_reading_twice_gives_the_same_bits(writer):
    content = writer.thermoscenes()
    content["k1"] = -0.1
    writer.transforms(content)
    image = load_scene(writer.root, resolution=20).train[0].images[RGB]
    assert torch.equal(image.load().values, image.load().values)


def test_random_start_points_follow_the_seed(writer):
    writer.transforms(writer.thermoscenes())
    first, again, other = (
        load_scene(writer.root, seed=seed).points.positions for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_images_can_be_sent_to_worker_processes(writer):
    writer.transforms(writer.thermoscenes())
    image = load_scene(writer.root).train[0].images[THERMAL]
    assert torch.equal(pickle.loads(pickle.dumps(image)).load().values, image.load().values)


def test_names_are_unique_stems():
    keys = ["images/a", "train/b", "test/b", "train_b", "x/a.b", "images/a"]
    names = _unique_names(keys)
    assert names == ["images_a", "train_b", "test_b", "train_b_2", "a.b", "images_a_2"]
