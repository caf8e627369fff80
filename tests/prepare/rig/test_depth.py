from __future__ import annotations

import numpy as np
import torch

from mrgs.prepare.rig.images import STEP_PX, inverse_depth
from mrgs.scene import Camera

CAMERA = Camera(
    torch.tensor([[200.0, 0, 100], [0, 200.0, 80], [0, 0, 1]], dtype=torch.float64),
    torch.eye(4, dtype=torch.float64),
    200,
    160,
)


def slanted(count: int) -> np.ndarray:
    """Points of the plane z = 4 + y that fill the image."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.6, 0.6, count), rng.uniform(-0.5, 0.5, count)
    z = 4 / (1 - y)
    return np.column_stack([x * z, y * z, z])


def test_a_plane_is_exact():
    found = inverse_depth(slanted(800), CAMERA)
    rows = (np.arange(found.values.shape[0]) + 0.5) * STEP_PX
    expected = (1 - (rows - 80) / 200) / 4
    inner = found.values[3:-3, 3:-3]
    np.testing.assert_allclose(inner, np.broadcast_to(expected[3:-3, None], inner.shape), rtol=1e-6)
    assert found.values.shape == (40, 50)


def test_points_behind_a_surface_are_left_out():
    rng = np.random.default_rng(1)
    near = np.column_stack(
        [rng.uniform(-0.4, 0.4, 600), rng.uniform(-0.4, 0.4, 600), np.full(600, 2.0)]
    )
    far = np.column_stack([rng.uniform(-2, 2, 600), rng.uniform(-2, 2, 600), np.full(600, 4.0)])
    found = inverse_depth(np.concatenate([near, far]), CAMERA)
    middle = found.values[16:24, 20:30]
    np.testing.assert_allclose(middle, 1 / 2.0, rtol=1e-6)
    np.testing.assert_allclose(found.values[:4, :4], 1 / 4.0, rtol=1e-6)


def test_known_visibility_is_taken_as_it_is():
    near = np.column_stack(
        [np.tile([-0.5, 0.0, 0.5], 3), np.repeat([-0.5, 0.0, 0.5], 3), np.full(9, 2.0)]
    )
    found = inverse_depth(np.concatenate([near * 2, near]), CAMERA, np.arange(9))
    np.testing.assert_allclose(found.values, 1 / 4.0, rtol=1e-6)


def test_a_stray_point_is_left_out():
    points = np.concatenate([slanted(800), [[0.0, 0.0, 1.0]]])
    found = inverse_depth(points, CAMERA)
    assert found.values.max() < 0.4


def test_too_few_points_give_none():
    assert inverse_depth(slanted(5), CAMERA) is None
    assert inverse_depth(slanted(100) * [1, 1, -1], CAMERA) is None
