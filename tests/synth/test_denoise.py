from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.scene import Camera
from mrgs_synth.cameras import look_at, pinhole
from mrgs_synth.colors import from_srgb
from mrgs_synth.denoise import Guide, denoised, without_speckles
from mrgs_synth.shapes import quad
from mrgs_synth.stage import Material, Solid, constant


@pytest.fixture(scope="module")
def scene() -> tuple[Guide, Camera, np.ndarray]:
    """A wall of black and white stripes, 2 × 2 m, seen from 1 m; its lower half stands 0.5 m
    behind the upper."""
    stripes = np.full((8, 32, 3), 230, dtype=np.uint8)
    stripes[:, ::4] = stripes[:, 1::4] = 40
    walls = []
    for name, y, low in (("upper", 0.0, 0.0), ("lower", 0.5, -1.0)):
        corners = [(-1.0, y, low), (1.0, y, low), (1.0, y, low + 1.0), (-1.0, y, low + 1.0)]
        walls.append(Solid(name, quad(np.array(corners)), Material(stripes), constant(0.0)))
    viewmat = torch.from_numpy(look_at(np.array([0.0, -1.0, 0.0]), np.zeros(3)))
    return Guide(walls), Camera(pinhole(60.0, 64, 48), viewmat, 64, 48), from_srgb(stripes)


def test_guides_are_the_geometry_and_the_texture(
    scene: tuple[Guide, Camera, np.ndarray],
) -> None:
    guide, camera, texture = scene
    guides = guide.of(camera)
    np.testing.assert_allclose(guides.normals[10, 32], [0.0, -1.0, 0.0], atol=1e-12)
    assert guides.positions[10, 32, 1] == pytest.approx(0.0)
    assert guides.positions[40, 32, 1] == pytest.approx(0.5)
    assert guides.distance[24, 32] == pytest.approx(1.5, abs=0.02)
    assert guides.albedo.min() >= texture.min() - 1e-12
    assert guides.albedo.max() <= texture.max() + 1e-12
    assert np.ptp(guides.albedo[10, :, 0]) > 0.5  # the stripes are there
    assert guides.albedo[10].mean() == pytest.approx(texture.mean(), abs=0.05)


def test_noise_goes_and_edges_stay(scene: tuple[Guide, Camera, np.ndarray]) -> None:
    guide, camera, _ = scene
    guides = guide.of(camera)
    light = np.where(guides.positions[..., 1:2] > 0.25, 0.2, 1.0)  # the lower wall is in shadow
    clean = guides.albedo * light
    noise = np.random.default_rng(0).gamma(4.0, 0.25, (4, 48, 64, 1))
    result = denoised(clean * noise, guides)
    before = np.abs((clean * noise).mean(axis=0) - clean).mean()
    assert np.abs(result - clean).mean() < 0.4 * before
    assert result.mean() == pytest.approx(clean.mean(), rel=0.03)
    ratio = result.mean(axis=(1, 2)) / clean.mean(axis=(1, 2))
    assert 0.8 < ratio[20:28].min() <= ratio[20:28].max() < 1.2  # beside the edge of the shadow


def test_one_speckle_is_left_out() -> None:
    shots = np.ones((4, 2, 2, 3))
    shots[2, 0, 0] = 50.0
    shots[:, 1, 1] = np.array([1.0, 1.5, 0.5, 1.0])[:, None]
    clean = without_speckles(shots)
    np.testing.assert_allclose(clean, 1.0)
