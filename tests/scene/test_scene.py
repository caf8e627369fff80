from __future__ import annotations

import pytest
import torch

from mrgs.scene import (
    RGB,
    THERMAL,
    Camera,
    Modality,
    Pixels,
    PointCloud,
    PosedImage,
    Scene,
    View,
)
from mrgs.scene.scene import TIMES_DEPTH
from tests.helpers.gaussians import NEAR_INFRARED


def image_at(*position: float) -> PosedImage:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -torch.tensor(position)
    K = torch.diag(torch.tensor([30.0, 30.0, 1.0], dtype=torch.float64))
    return PosedImage(Camera(K, viewmat, 40, 30), lambda: Pixels(torch.zeros(30, 40, 1)))


def view_of(*modalities: Modality) -> View:
    return View("a", dict.fromkeys(modalities, image_at(0, 0, 0)))


def scene_of(*train: View) -> Scene:
    points = PointCloud(torch.zeros(1, 3), torch.zeros(1, 3))
    return Scene("scene", tuple(train), (), points, None)


def test_extent_is_the_radius_of_all_training_cameras():
    rgb_alone, both = (
        View("a", {RGB: image_at(4, 5, 6)}),
        View("b", {RGB: image_at(0, 5, 6), THERMAL: image_at(2, 5, 6)}),
    )
    assert scene_of(rgb_alone, both).extent == pytest.approx(1.1 * 2)


def test_extent_of_a_survey_from_above_follows_from_how_far_its_cameras_see():
    lens = Camera.from_fov(64, 48, 40.0)
    x, y = torch.meshgrid(torch.arange(100.0), torch.arange(40.0), indexing="ij")
    points = torch.stack([x, y, 0 * x], dim=2).flatten(0, 1)
    for span, expected in ((100.0, TIMES_DEPTH * 10.0), (8.0, 1.1 * 4.0)):
        eyes = [(span * step / 40, 20.0, 10.0) for step in range(41)]
        cameras = [lens.look_at(eye, (eye[0], 20.0, 0.0), up=(0.0, 1.0, 0.0)) for eye in eyes]
        views = [View("v", {RGB: PosedImage(each, lambda: Pixels(None))}) for each in cameras]
        cloud = PointCloud(points, torch.zeros(4000, 3))
        assert Scene("flight", tuple(views), (), cloud, None).extent == pytest.approx(expected)


def test_extent_of_cameras_that_stand_still_is_the_distance_of_the_points():
    points = PointCloud(
        torch.tensor([[1.0, 2.0, 5.0], [1.0, 2.0, 7.0], [1.0, 2.0, 90.0]]), torch.zeros(3, 3)
    )
    still, moved = View("a", {RGB: image_at(1, 2, 3)}), View("b", {RGB: image_at(1, 2, 3.0001)})
    for views in ((still,), (still, moved)):
        assert Scene("scene", views, (), points, None).extent == pytest.approx(4, rel=1e-4)


def test_each_training_view_has_one_camera_for_its_place():
    both, thermal = (
        View("a", {RGB: image_at(1, 0, 0), THERMAL: image_at(2, 0, 0)}),
        view_of(THERMAL),
    )
    cameras = scene_of(both, thermal).train_cameras
    assert cameras == [both.images[RGB].camera, thermal.images[THERMAL].camera]


def test_a_scene_has_the_modalities_of_any_training_view():
    assert scene_of(view_of(RGB)).modalities == (RGB,)
    assert scene_of(view_of(THERMAL)).modalities == (THERMAL,)
    assert scene_of(view_of(THERMAL), view_of(RGB)).modalities == (RGB, THERMAL)


def test_further_modalities_follow_in_the_order_of_their_names():
    ultraviolet = Modality("uv", 1)
    scene = scene_of(view_of(ultraviolet, THERMAL), view_of(NEAR_INFRARED, RGB))
    assert scene.modalities == (RGB, THERMAL, NEAR_INFRARED, ultraviolet)
