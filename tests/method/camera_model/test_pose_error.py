from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mrgs.field import FieldConfig, RadianceField
from mrgs.method.camera_model.point_spread import blur
from mrgs.method.camera_model.pose_error import (
    MOST_PIXELS,
    Alignable,
    PoseAgreement,
    _half,
    agreement,
    halves_px,
    pose_error,
)
from mrgs.method.camera_model.pose_refinement import effect, motion_axes, shift_per_motion
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model, render
from mrgs.scene import RGB, Camera
from mrgs.scene.rotations import matrix_from_rotvec, rigid_transform
from tests.helpers.gaussians import random_gaussians

SIZE = 96, 72
CAMERA = Camera.from_fov(*SIZE, 60).look_at((0.5, -4.5, 1.0), (0, 0, 0))
MOTION = torch.tensor([0.5, -0.8, 0.4, 0.7, -0.5, 0.6], dtype=torch.float64)


@pytest.fixture(scope="module")
def model() -> Model:
    gaussians = random_gaussians(300, bands=15)
    gaussians = replace(gaussians, log_scales=0.2 * gaussians.log_scales - 1.6)
    field = RadianceField(FieldConfig(residuals=False))
    return Model(gaussians, field, None, dilation=Dilation(0.3))


def axes_px(camera: Camera = CAMERA) -> Tensor:
    """Turns and translations of a pixel each, at the distance of the model."""
    distance = camera.position.norm()
    scales = torch.tensor([1.0, 1, 1, distance, distance, distance], dtype=torch.float64)
    return torch.diag(scales) / camera.focal_px


def moved(camera: Camera, motion: Tensor) -> Camera:
    """The camera that sees the world after a motion about the first camera's centre."""
    turn, shift = (axes_px() @ motion).split(3)
    rotation = matrix_from_rotvec(turn.numpy())
    about = rigid_transform(rotation, shift.numpy()).clone()
    centre = CAMERA.position
    about[:3, 3] += centre - about[:3, :3] @ centre
    return Camera(camera.K, camera.viewmat @ about, camera.width, camera.height)


def seen(model: Model, camera: Camera, motion: Tensor = MOTION) -> Alignable:
    """What a camera renders, and a photo that was taken after a motion of the world."""
    with torch.no_grad():
        rendering = render(model, {RGB: camera})[0]
        photo = render(model, {RGB: moved(camera, motion)})[0][RGB].image
    return Alignable(camera, photo, None, rendering[RGB].image, rendering.surface_depth(RGB))


def found(*images: Alignable) -> Tensor:
    return pose_error(images, CAMERA.position, axes_px())


def assert_found(motion: Tensor, within_px: float) -> None:
    """Of the six numbers, what shifts the image is compared: turns and translations may stand in
    for each other."""
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(1)).double()
    shifts = shift_per_motion(CAMERA, points, CAMERA.position) * CAMERA.focal_px
    apart = shifts @ (axes_px() @ (motion - MOTION))
    before = shifts @ (axes_px() @ MOTION)
    assert before.norm(dim=1).mean() > 1
    assert apart.norm(dim=1).mean() < within_px


def test_the_motion_between_photo_and_rendering_is_found(model):
    assert_found(found(seen(model, CAMERA)), within_px=0.1)


def test_a_pose_that_is_right_is_found_to_be(model):
    assert found(seen(model, CAMERA, torch.zeros(6).double())).norm() < 1e-6


def test_a_photo_may_be_brighter(model):
    image = seen(model, CAMERA)
    assert_found(found(image._replace(photo=image.photo + 0.2)), within_px=0.1)


def test_what_the_model_lacks_does_not_count(model):
    image = seen(model, CAMERA)
    photo = image.photo.clone()
    photo[20:50, 30:60] = torch.rand(30, 30, 3, generator=torch.Generator().manual_seed(2))
    assert_found(found(image._replace(photo=photo)), within_px=0.2)


def test_pixels_that_are_not_valid_do_not_count_whatever_they_hold(model):
    image = seen(model, CAMERA)
    valid = torch.ones(72, 96, dtype=torch.bool)
    valid[:, 60:] = False
    photo = torch.where(valid[:, :, None], image.photo, torch.nan)
    assert_found(found(image._replace(photo=photo, valid=valid)), within_px=0.2)


def test_of_what_shows_no_texture_or_no_surface_nothing_is_claimed(model):
    image = seen(model, CAMERA)
    even = torch.full_like(image.photo, 0.5)
    assert found(image._replace(photo=even + 0.01, rendering=even)).norm() < 1e-6
    nowhere = torch.full_like(image.depth, torch.nan)
    assert found(image._replace(depth=nowhere)).norm() == 0


def test_all_cameras_of_a_view_tell_of_one_motion(model):
    other = Camera.from_fov(48, 36, 50).look_at((0.9, -4.4, 1.1), (0, 0, 0))
    first, second = seen(model, CAMERA), seen(model, other)
    thermal = second._replace(photo=second.photo[:, :, :1], rendering=second.rendering[:, :, :1])
    assert_found(found(thermal), within_px=0.5)
    assert_found(found(first, thermal), within_px=0.1)


def test_large_photos_are_sampled(model):
    large = CAMERA.resized(288, 216)
    assert large.width * large.height > 4 * MOST_PIXELS
    assert_found(found(seen(model, large)), within_px=0.3)


@pytest.mark.parametrize("size", [(96, 72), (640, 480), (507, 380), (321, 243)])
def test_both_halves_of_a_photo_are_sampled(size):
    width, height = size
    step = math.ceil(math.sqrt(width * height / MOST_PIXELS))
    counts = [
        int(_half(torch.ones(height, width), which)[::step, ::step].isfinite().sum())
        for which in (0, 1)
    ]
    assert min(counts) > 0.4 * sum(counts)


@pytest.mark.parametrize(
    ("agreed", "apart", "is_wrong", "is_right"),
    [
        (0.1, 0.0, False, True),
        (0.3, 0.0, False, True),
        (0.5, 0.2, True, False),
        (0.5, 0.45, False, False),
        (0.72, 0.65, False, False),
        (2.4, 1.8, False, False),
        (2.0, 2.5, False, False),
    ],
)
def test_poses_are_wrong_by_what_the_halves_agree_on(agreed, apart, is_wrong, is_right):
    found = PoseAgreement(agreed, apart)
    assert (found.is_wrong, found.is_right) == (is_wrong, is_right)


def test_motions_that_a_view_hardly_tells_do_not_count():
    """A model at a wrong depth moves both halves of all views along these."""
    halves = torch.zeros(2, 5, 6, dtype=torch.float64)
    halves[:, :, :2] = 3.0
    assert agreement(*halves) == PoseAgreement(0.0, 0.0)
    halves[0, :, 5], halves[1, :, 5] = 2.0, 0.5
    assert agreement(*halves) == PoseAgreement(1.0, 1.5)
    halves[1, :, 5] = -2.0
    assert agreement(*halves) == PoseAgreement(0.0, 4.0)


def test_either_half_of_an_image_tells_the_motion(model):
    """Along the axes in which the view tells most."""
    image = seen(model, CAMERA)
    depth = image.depth[image.depth.isfinite()].double()
    points = CAMERA.unproject_image(image.depth.double())[image.depth.isfinite()]
    assert len(depth) > 1000
    axes = motion_axes(effect(CAMERA, points)) / CAMERA.focal_px
    expected = torch.linalg.solve(axes, axes_px() @ MOTION)
    halves = halves_px([image], CAMERA.position, axes)
    for half in halves:
        assert (half - expected)[-2:].norm() < 0.25 * expected[-2:].norm()
    assert not torch.equal(*halves)


def test_a_motion_that_is_larger_than_the_details_is_found():
    """All of a wide photo is 12 pixels off, its details are two or three wide."""
    camera, distance, off = Camera.from_fov(480, 360, 60), 4.0, 12
    noise = torch.rand(360, 480 + off, generator=torch.Generator().manual_seed(0))
    details = blur(noise, torch.tensor(1.5))[:, :, None]
    depth = torch.full((360, 480), distance)
    image = Alignable(camera, details[:, :480], None, details[:, off:], depth)
    scales = torch.tensor([1.0, 1, 1, distance, distance, distance], dtype=torch.float64)
    axes = torch.diag(scales) / camera.focal_px
    pixels = 360 * torch.rand(50, 2, generator=torch.Generator().manual_seed(1)).double()
    points = camera.unproject(pixels, distance)
    shifts = shift_per_motion(camera, points, camera.position) * camera.focal_px
    seen_at = shifts @ axes @ pose_error([image], camera.position, axes)
    torch.testing.assert_close(
        seen_at, torch.tensor([[12.0, 0.0]] * 50).double(), atol=0.05, rtol=0
    )


def test_pixels_need_not_be_square(model):
    K = CAMERA.K.clone()
    K[1, 1] *= 1.5
    stretched = Camera(K, CAMERA.viewmat, *SIZE)
    assert_found(found(seen(model, stretched)), within_px=0.1)


def test_where_halves_say_the_contrary_nothing_is_wrong():
    found = torch.randn(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert agreement(found, -found).agreed_px == 0


def test_what_cannot_be_told_is_no_motion(model):
    image = seen(model, CAMERA)
    nothing = image._replace(photo=torch.full_like(image.photo, torch.nan))
    assert torch.equal(found(nothing), torch.zeros(6, dtype=torch.float64))
