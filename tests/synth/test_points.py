from __future__ import annotations

import numpy as np

from mrgs_synth.hits import Triangles, first_hits
from mrgs_synth.points import sparse_points, visible
from mrgs_synth.stage import Stage


def test_points_lie_on_surfaces_that_two_cameras_see(two_boxes: Stage) -> None:
    rng = np.random.default_rng(0)
    cameras = two_boxes.cameras.train(6, 64, 48, rng)
    triangles = Triangles.of(two_boxes.solids)
    hits = [first_hits(camera, triangles) for camera in cameras]
    palette = np.array([[128, 128, 128], [220, 20, 20]], dtype=np.uint8)
    photos = [palette[hit.solid] for hit in hits]
    positions, colors = sparse_points(cameras, hits, photos, 500, 0.002, rng)
    assert positions.shape == colors.shape == (500, 3)
    red = colors[:, 0] == 220
    assert 0 < red.sum() < 500
    assert np.abs(positions[~red, 2]).max() < 0.012  # the floor, six standard deviations
    assert positions[red, 2].min() > -0.012
    assert positions[red, 2].max() < 0.212
    seen = sum(
        visible(positions, camera, hit).astype(int)
        for camera, hit in zip(cameras, hits, strict=True)
    )
    assert np.mean(seen >= 2) > 0.95  # the noise moves a few across an outline


def test_points_stray_as_far_as_asked(two_boxes: Stage) -> None:
    cameras = two_boxes.cameras.train(3, 64, 48, np.random.default_rng(0))
    hits = [first_hits(camera, Triangles.of(two_boxes.solids[:1])) for camera in cameras]
    photos = [np.zeros((48, 64, 3), dtype=np.uint8)] * 3
    for noise_m in (0.0, 0.05):
        positions, _ = sparse_points(cameras, hits, photos, 2000, noise_m, np.random.default_rng(1))
        assert abs(positions[:, 2].std() - noise_m) <= 0.1 * noise_m + 1e-9  # the floor is z = 0


def test_hidden_and_outside_points_are_not_visible(two_boxes: Stage) -> None:
    camera = two_boxes.cameras.train(2, 64, 48, np.random.default_rng(0))[0]
    hits = first_hits(camera, Triangles.of(two_boxes.solids))
    on_surface = hits.points[::6, ::6].reshape(-1, 3)
    assert visible(on_surface, camera, hits).all()
    away = on_surface - camera.position.numpy()
    assert not visible(on_surface + 0.1 * away, camera, hits).any()
    assert not visible(camera.position.numpy() - away, camera, hits).any()
