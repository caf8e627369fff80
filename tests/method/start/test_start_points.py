from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mrgs.method.config import make_config
from mrgs.method.start.distant_points import distant_points
from mrgs.method.start.start_points import (
    DISTANT_OPACITY,
    NEARER_OPACITY,
    OPACITY,
    THERMAL_OPACITY,
    start_points,
)
from mrgs.scene import RGB, THERMAL, Camera, Modality, Pixels, PointCloud, PosedImage, Scene, View
from tests.helpers.gaussians import NEAR_INFRARED

WIDTH, HEIGHT = 48, 36
WALL_C, SKY_C = 0.8, 0.1
SKY = torch.tensor([0.3, 0.5, 0.9])
GREY = (torch.tensor([SKY_C]), torch.tensor([WALL_C]))
"""Sky and wall in photos of one channel."""


def image(above: Tensor, below: Tensor, camera: Camera) -> PosedImage:
    """One value above the horizon, another below it."""
    upper = torch.arange(HEIGHT)[:, None, None] < HEIGHT // 2
    return PosedImage(
        camera,
        lambda: Pixels(torch.where(upper, above, below).expand(HEIGHT, WIDTH, -1).contiguous()),
    )


def wall_under_sky(modalities: Sequence[Modality] = (RGB, THERMAL)) -> Scene:
    """A wall of grey points fills the lower half of the only photo, from 3 units before the
    camera."""
    K = torch.tensor(
        [[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64
    )
    camera = Camera(K, torch.eye(4, dtype=torch.float64), WIDTH, HEIGHT)
    rows, columns = torch.arange(HEIGHT // 2, HEIGHT), torch.arange(WIDTH)
    pixels = torch.cartesian_prod(columns, rows).double() + 0.5
    positions = camera.unproject(pixels, torch.full((len(pixels),), 3.0).double()).float()
    values = {RGB: (SKY, torch.tensor([0.2, 0.2, 0.2]))}
    images = {modality: image(*values.get(modality, GREY), camera) for modality in modalities}
    points = PointCloud(positions, torch.full_like(positions, 0.4))
    return Scene("wall", (View("one", images),), (), points, None)


def test_the_scenes_own_points_keep_their_colours_and_get_temperatures():
    scene = wall_under_sky()
    found = start_points(scene, make_config("mrgs", "fast"))
    own = slice(len(scene.points.positions))
    assert torch.equal(found.positions[own], scene.points.positions)
    assert torch.equal(found.values[RGB][own], scene.points.colors)
    torch.testing.assert_close(
        found.values[THERMAL][own], torch.full_like(found.values[THERMAL][own], WALL_C)
    )
    assert (found.opacities[RGB][own] == NEARER_OPACITY).all()
    assert (found.opacities[THERMAL][own] == THERMAL_OPACITY).all()


def test_the_sky_is_opaque_and_as_the_photos_show_it():
    scene = wall_under_sky()
    count = len(scene.points.positions)
    found = start_points(scene, make_config("mrgs", "fast"))
    assert len(found.positions) > count + 30
    assert (found.opacities[RGB][count:] == DISTANT_OPACITY).all()
    assert (found.opacities[THERMAL][count:] == DISTANT_OPACITY).all()
    torch.testing.assert_close(
        found.values[THERMAL][count:], torch.full_like(found.values[THERMAL][count:], SKY_C)
    )
    torch.testing.assert_close(
        found.values[RGB][count:], SKY.expand(len(found.positions) - count, 3)
    )


def test_only_the_sky_is_limited_in_size():
    scene = wall_under_sky()
    count = len(scene.points.positions)
    found = start_points(scene, make_config("mrgs", "fast"))
    assert found.max_scales[:count].isinf().all()
    spacing = distant_points(scene.points.positions, scene.train_cameras).spacing
    torch.testing.assert_close(
        found.max_scales[count:], torch.full_like(found.max_scales[count:], 2 * spacing)
    )


@pytest.mark.parametrize("photographed", [RGB, THERMAL])
def test_a_modality_without_photos_says_nothing(photographed):
    scene = wall_under_sky([photographed])
    found = start_points(scene, make_config("mrgs", "fast"))
    if photographed == THERMAL:
        assert found.values[RGB][len(scene.points.positions) :].isnan().all()
    else:
        assert found.values[THERMAL].isnan().all()
        assert (found.opacities[THERMAL] == found.opacities[RGB]).all()


def test_points_that_no_thermal_photo_shows_start_as_their_neighbours():
    scene = wall_under_sky()
    beside = torch.tensor([[100.0, 0.0, 0.0]])  # in no photo
    cloud = PointCloud(
        torch.cat([scene.points.positions, beside]), torch.cat([scene.points.colors, beside * 0])
    )
    found = start_points(
        replace(scene, points=cloud), replace(make_config("mrgs", "paper"), photo_temperatures=True)
    )
    count = len(scene.points.positions)
    assert found.values[THERMAL][count].item() == pytest.approx(WALL_C)
    assert found.opacities[THERMAL][count] == found.opacities[THERMAL][0]


def test_a_third_modality_starts_like_the_temperatures():
    found = start_points(wall_under_sky([RGB, THERMAL, NEAR_INFRARED]), make_config("mrgs", "fast"))
    assert list(found.values) == [RGB, THERMAL, NEAR_INFRARED]
    torch.testing.assert_close(
        found.values[NEAR_INFRARED], found.values[THERMAL], equal_nan=True, atol=0, rtol=0
    )
    assert torch.equal(found.opacities[NEAR_INFRARED], found.opacities[THERMAL])


def test_as_published_only_the_scenes_points_are_there():
    scene = wall_under_sky()
    found = start_points(scene, make_config("mrgs", "paper"))
    assert torch.equal(found.positions, scene.points.positions)
    assert found.values[THERMAL].isnan().all()
    assert (found.opacities[RGB] == OPACITY).all()
    assert (found.opacities[THERMAL] == OPACITY).all()


def test_each_switch_acts_alone():
    scene = wall_under_sky()
    published = make_config("mrgs", "paper")
    warm = start_points(scene, replace(published, photo_temperatures=True))
    far = start_points(scene, replace(published, distant_points=True))
    assert len(warm.positions) == len(scene.points.positions)
    assert (warm.opacities[RGB] == OPACITY).all()
    torch.testing.assert_close(warm.values[THERMAL], torch.full_like(warm.values[THERMAL], WALL_C))
    assert len(far.positions) > len(scene.points.positions)
    assert far.values[THERMAL].isnan().all()
    assert torch.equal(far.opacities[THERMAL], far.opacities[RGB])
