from __future__ import annotations

import pytest
import torch

from mrgs.scene import RGB, THERMAL, Camera, Pixels, PosedImage, View, evenly_spaced
from tests.helpers.gaussians import NEAR_INFRARED


def image_at(*position: float, focal: float = 30.0) -> PosedImage:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -torch.tensor(position)
    K = torch.diag(torch.tensor([focal, focal, 1.0], dtype=torch.float64))
    return PosedImage(Camera(K, viewmat, 40, 30), lambda: Pixels(torch.zeros(30, 40, 1)))


def test_a_view_needs_an_image():
    with pytest.raises(ValueError, match="view 7 has"):
        View("7", {})


def test_cameras_of_a_view_are_those_of_its_images():
    images = {RGB: image_at(0, 0, 0), THERMAL: image_at(1, 0, 0), NEAR_INFRARED: image_at(2, 0, 0)}
    view = View("a", images)
    assert view.cameras == {modality: image.camera for modality, image in images.items()}
    assert list(view.cameras) == [RGB, THERMAL, NEAR_INFRARED]
    assert view.camera is images[RGB].camera
    assert View("a", {THERMAL: images[THERMAL]}).camera is images[THERMAL].camera


def test_one_camera_stands_for_two_images_only_if_both_have_it():
    def shares(one: PosedImage, other: PosedImage) -> bool:
        return View("a", {RGB: one, THERMAL: other}).shares_camera(RGB, THERMAL)

    assert shares(image_at(0, 0, 0), image_at(0, 0, 0))
    assert not shares(image_at(0, 0, 0), image_at(0, 0, 0.1))
    assert not shares(image_at(0, 0, 0), image_at(0, 0, 0, focal=31.0))
    alone = View("a", {RGB: image_at(0, 0, 0)})
    assert not alone.shares_camera(RGB, THERMAL)
    assert not alone.shares_camera(THERMAL, RGB)


def test_any_two_modalities_can_be_compared():
    here, there = image_at(0, 0, 0), image_at(1, 0, 0)
    view = View("a", {RGB: here, THERMAL: there, NEAR_INFRARED: here})
    assert view.shares_camera(RGB, NEAR_INFRARED)
    assert not view.shares_camera(THERMAL, NEAR_INFRARED)


@pytest.mark.parametrize(
    ("count", "indices"),
    [(0, []), (1, [0]), (3, [0, 1, 2]), (5, [0, 1, 2, 3, 4]), (9, [0, 2, 4, 6, 8])],
)
def test_views_are_chosen_evenly_spread(count, indices):
    assert evenly_spaced(count) == indices
