"""The real two-camera scene, where it is at hand."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from mrgs.data import load_scene
from mrgs.scene import RGB, THERMAL

BOARD = Path(__file__).parents[3] / "shared/scenes/board"


@pytest.mark.skipif(not BOARD.is_dir(), reason="the board scene does not lie beside the repository")
def test_board():
    scene = load_scene(BOARD, resolution=507)
    assert (len(scene.train), len(scene.eval)) == (42, 5)
    assert scene.points.positions.shape == (21_556, 3)
    assert scene.points.positions.norm(dim=1).max() > 70  # far points are real
    assert scene.temperature is None
    view = scene.eval[0]
    assert not view.shares_camera(RGB, THERMAL)
    assert (view.images[RGB].camera.width, view.images[RGB].camera.height) == (507, 380)
    assert (view.images[THERMAL].camera.width, view.images[THERMAL].camera.height) == (507, 380)
    for image, channels in ((view.images[RGB], 3), (view.images[THERMAL], 1)):
        pixels = image.load()
        assert pixels.values.shape == (380, 507, channels)
        assert pixels.valid is None
        assert 0 <= pixels.values.min() < pixels.values.max() <= 1
    points = torch.cat([scene.points.positions.double(), torch.ones(21_556, 1)], dim=1)
    in_camera = points @ view.images[RGB].camera.viewmat.T
    pixel = in_camera[:, :3] @ view.images[RGB].camera.K.T
    seen = (pixel[:, 2] > 0) & (pixel[:, 0] > 0) & (pixel[:, 0] < 507 * pixel[:, 2])
    assert seen.float().mean() > 0.5
