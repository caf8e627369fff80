from __future__ import annotations

import json
import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.viewer.inspection import nearest_view
from mrgs.viewer.panes import fitted_size
from mrgs.viewer.saving import save_path, smooth_path, vertical_fov
from mrgs.viewer.server import camera_around


def test_a_browser_camera_is_a_pinhole(camera):
    torch.testing.assert_close(camera.position, torch.tensor([3.0, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(camera.forward, torch.tensor([-1.0, 0, 0], dtype=torch.float64))
    assert vertical_fov(camera) == pytest.approx(math.radians(45))


def test_sizes_are_reduced_only():
    assert fitted_size(1600, 800, 400) == (400, 200)
    assert fitted_size(300, 200, 400) == (300, 200)
    assert fitted_size(5000, 1, 400) == (400, 1)


def test_without_cameras_the_model_is_seen_upright():
    means = np.random.default_rng(0).normal([5, 0, 0], 0.3, (200, 3)).astype(np.float32)
    camera = camera_around(means)
    pixels, depth = camera.project(torch.from_numpy(means))
    assert camera.contains(pixels).double().mean() > 0.95
    assert depth.min() > 0
    assert camera.viewmat[1, 2] < -0.5, "z is not up"


def test_the_nearest_view_is_found_and_ties_are_kept(balls):
    views = balls.train
    for index, view in enumerate(views):
        assert nearest_view(views, view.camera, balls.extent) == index
    twice = (views[0], views[0])
    assert nearest_view(twice, views[0].camera, balls.extent, preferred=1) == 1


def test_a_path_goes_through_its_keyframes(balls):
    keyframes = [view.camera for view in balls.train[:3]]
    path = smooth_path(keyframes, 21)
    assert len(path) == 21
    for keyframe, found in zip(keyframes, (path[0], path[10], path[20]), strict=True):
        np.testing.assert_allclose(found.viewmat.numpy(), keyframe.viewmat.numpy(), atol=1e-6)
    steps = [np.linalg.norm((a.position - b.position).numpy()) for a, b in pairwise(path)]
    assert max(steps) < 2.5 * min(steps)


def test_one_keyframe_is_no_path(camera):
    with pytest.raises(ConfigError, match="two keyframes"):
        smooth_path([camera], 10)


def test_a_saved_path_is_nerfstudios(camera, tmp_path):
    document = json.loads(save_path(tmp_path / "path.json", [camera, camera], 4.0, 24).read_text())
    assert (document["render_width"], document["render_height"], document["seconds"]) == (
        160,
        120,
        4.0,
    )
    entry = document["camera_path"][0]
    world = np.array(entry["camera_to_world"]).reshape(4, 4)
    np.testing.assert_allclose(world[:3, 3], [3, 0, 0], atol=1e-9)
    np.testing.assert_allclose(world[:3, 2], [1, 0, 0], atol=1e-9)  # OpenGL: backwards
    np.testing.assert_allclose(world[:3, 1], [0, 0, 1], atol=1e-9)  # up
    assert entry["fov"] == pytest.approx(45)


def test_a_path_without_keyframes_is_not_saved(tmp_path):
    with pytest.raises(ConfigError, match="no keyframes"):
        save_path(tmp_path / "path.json", [], 4.0, 24)
    assert not list(tmp_path.iterdir())
