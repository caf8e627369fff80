from __future__ import annotations

import pytest
import torch

from mrgs.scene import Camera, Pixels, PointCloud, PosedImage, Scene, View


def image_at(*position: float, focal: float = 30.0) -> PosedImage:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -torch.tensor(position)
    K = torch.diag(torch.tensor([focal, focal, 1.0], dtype=torch.float64))
    return PosedImage(Camera(K, viewmat, 40, 30), lambda: Pixels(torch.zeros(30, 40, 1)))


def scene_of(*train: View) -> Scene:
    points = PointCloud(torch.zeros(1, 3), torch.zeros(1, 3))
    return Scene("scene", tuple(train), (), points, None)


def test_a_view_needs_an_image():
    with pytest.raises(ValueError, match="view 7 has neither an RGB nor a thermal image"):
        View("7", None, None)


def test_cameras_of_a_view_are_those_of_its_images():
    rgb, thermal = image_at(0, 0, 0), image_at(1, 0, 0)
    assert View("a", rgb, thermal).cameras == (rgb.camera, thermal.camera)
    assert View("a", None, thermal).cameras == (thermal.camera,)
    assert View("a", rgb, None).cameras == (rgb.camera,)


def test_one_camera_serves_a_view_only_if_both_images_have_it():
    assert View("a", image_at(0, 0, 0), image_at(0, 0, 0)).shares_camera
    assert not View("a", image_at(0, 0, 0), image_at(0, 0, 0.1)).shares_camera
    assert not View("a", image_at(0, 0, 0), image_at(0, 0, 0, focal=31.0)).shares_camera
    assert not View("a", image_at(0, 0, 0), None).shares_camera


def test_extent_is_the_radius_of_all_training_cameras():
    rgb_alone, both = (
        View("a", image_at(4, 5, 6), None),
        View("b", image_at(0, 5, 6), image_at(2, 5, 6)),
    )
    assert scene_of(rgb_alone, both).extent == pytest.approx(1.1 * 2)


def test_extent_of_cameras_that_stand_still_is_the_distance_of_the_points():
    points = PointCloud(
        torch.tensor([[1.0, 2.0, 5.0], [1.0, 2.0, 7.0], [1.0, 2.0, 90.0]]), torch.zeros(3, 3)
    )
    still, moved = View("a", image_at(1, 2, 3), None), View("b", image_at(1, 2, 3.0001), None)
    for views in ((still,), (still, moved)):
        assert Scene("scene", views, (), points, None).extent == pytest.approx(4, rel=1e-4)


def test_a_scene_has_what_any_training_view_has():
    rgb, thermal = View("a", image_at(0, 0, 0), None), View("b", None, image_at(0, 0, 0))
    assert (scene_of(rgb).has_rgb, scene_of(rgb).has_thermal) == (True, False)
    assert (scene_of(thermal).has_rgb, scene_of(thermal).has_thermal) == (False, True)
    assert (scene_of(rgb, thermal).has_rgb, scene_of(rgb, thermal).has_thermal) == (True, True)
