from __future__ import annotations

import numpy as np
import torch

from mrgs.scene import Camera
from mrgs.scene.preview import best_view

POINTS = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (500, 3)))
K = torch.tensor([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]], dtype=torch.float64)


def camera(position: tuple[float, ...], target: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Camera:
    return Camera(K, torch.eye(4), 80, 60).look_at(position, target)


def test_the_view_that_shows_most_is_best():
    near, far, away = camera((1.2, 0, 0)), camera((5, 0, 0)), camera((5, 0, 0), (10, 0, 0))
    assert best_view([near, away, far], POINTS) == 2


def test_of_equal_views_the_one_towards_the_middle_is_best():
    aside, straight = camera((0, 9, 0), (0.4, 0, 0)), camera((9, 0, 0))
    assert best_view([aside, straight], POINTS) == 1
