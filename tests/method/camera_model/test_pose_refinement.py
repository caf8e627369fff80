from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mrgs.field import FieldConfig, RadianceField
from mrgs.method.adam import Adam, ParameterGroup
from mrgs.method.camera_model.pose_refinement import PoseRefinement
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model, render
from mrgs.scene import RGB, THERMAL, Camera
from tests.helpers.gaussians import random_gaussians

SIZE = 48, 36
POINTS = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))


def orbit(count: int) -> list[Camera]:
    """Cameras about the points, at two heights, so that no motion of all of them is one of none."""
    camera = Camera.from_fov(*SIZE, 60)
    places = [
        (5 * math.cos(angle), 5 * math.sin(angle), 1.5 * (-1) ** number)
        for number, angle in enumerate(torch.linspace(0, 5, count).tolist())
    ]
    return [camera.look_at(place, (0, 0, 0)) for place in places]


def refinement(cameras: list[Camera]) -> PoseRefinement:
    poses = PoseRefinement(len(cameras))
    poses.set_frame(cameras, POINTS)
    return poses


def at(view: int) -> Tensor:
    return torch.tensor([view])


def shift_px(camera: Camera, motion: Tensor) -> float:
    """Root mean square of the shifts of the points in a camera's image."""
    points = POINTS.double()
    before, _ = camera.project(points)
    after, _ = camera.project(points @ motion[:3, :3].T + motion[:3, 3])
    seen = camera.contains(before)
    return (after - before)[seen].square().sum(dim=1).mean().sqrt().item()


def test_at_the_start_cameras_are_where_they_were_given():
    cameras = orbit(4)
    poses = refinement(cameras)
    for view, camera in enumerate(cameras):
        found = poses.refined({RGB: camera, THERMAL: camera.resized(12, 9)}, at(view))
        viewmat = found[RGB].tensors(torch.device("cpu")).viewmat
        torch.testing.assert_close(viewmat, camera.viewmat, rtol=0, atol=1e-14)
        assert found[RGB].coincides_with(camera)
        assert found[THERMAL].width == 12
    assert poses.shifts().tolist() == [0, 0, 0, 0]


def test_motions_are_as_long_as_they_shift_the_image():
    cameras = orbit(6)
    poses = refinement(cameras)
    poses.whole.zero_()
    poses.motions.data[:, 3:] = 0.01 * torch.eye(3).repeat(2, 1)
    for view, camera in enumerate(cameras):
        told = poses.shifts()[view].item() * camera.focal_px
        assert told == pytest.approx(0.01 * camera.focal_px)
        assert shift_px(camera, poses.motion(at(view)).detach()) == pytest.approx(told, rel=0.05)


@pytest.mark.parametrize("whole", range(7))
def test_what_moves_turns_or_scales_the_whole_scene_moves_no_camera(whole):
    poses = refinement(orbit(5))
    poses.motions.data = 0.1 * poses.whole[:, whole].view(-1, 6).float()
    assert poses.shifts().max() < 1e-7


def test_a_rotation_of_the_world_is_one_of_the_whole():
    cameras = orbit(5)
    poses = refinement(cameras)
    turn = torch.tensor([0.02, -0.01, 0.03], dtype=torch.float64)
    shifts = torch.linalg.cross(turn.expand(5, 3), poses.centres)
    given = torch.cat([turn.expand(5, 3), shifts], dim=1)
    poses.motions.data = torch.linalg.solve(poses.axes, given[:, :, None])[..., 0].float()
    assert poses.motions.norm() > 0.01
    assert poses.shifts().max() < 1e-6


def test_the_frame_has_the_same_bits_with_any_number_of_threads():
    before = torch.get_num_threads()
    try:
        frames = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            frames.append(refinement(orbit(40)).state_dict())
    finally:
        torch.set_num_threads(before)
    for name, tensor in frames[0].items():
        assert torch.equal(tensor, frames[1][name]), name


def test_motions_of_the_whole_are_unit_vectors_normal_to_each_other():
    poses = refinement(orbit(9))
    eye = torch.eye(7, dtype=torch.float64)
    torch.testing.assert_close(poses.whole.T @ poses.whole, eye, rtol=0, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2])
def test_few_cameras_or_no_points_are_no_error(count):
    cameras = orbit(count)
    poses = PoseRefinement(count)
    poses.set_frame(cameras, torch.full((3, 3), 1e3))
    poses.motions.data.fill_(0.01)
    assert poses.motion(at(0)).isfinite().all()


def test_wrong_poses_are_found_from_the_photos():
    cameras = orbit(6)
    gaussians = random_gaussians(80, bands=15)
    gaussians = replace(gaussians, log_scales=0.2 * gaussians.log_scales - 1.5)
    model = Model(
        gaussians, RadianceField(FieldConfig(residuals=False)), None, dilation=Dilation(0.3)
    )
    with torch.no_grad():
        photos = [render(model, {RGB: camera})[0][RGB].image for camera in cameras]
    errors = refinement(cameras)
    errors.motions.data.normal_(0, 0.015, generator=torch.Generator().manual_seed(1))
    given = [
        Camera(camera.K, camera.viewmat @ errors.motion(at(view)).detach(), *SIZE)
        for view, camera in enumerate(cameras)
    ]
    poses = refinement(given)
    poses.whole.zero_()  # the model stands still, and cannot move as a whole
    adam = Adam([ParameterGroup([poses.motions], 1e-3)])
    for step in range(240):
        view = step % 6
        adam.set_rates(1.0 if step < 150 else 0.1)
        found = render(model, poses.refined({RGB: given[view]}, at(view)))[0][RGB].image
        (found - photos[view]).abs().mean().backward()
        adam.step()
        adam.zero_grad()

    def mean_error_px(motions: list[Tensor]) -> float:
        viewmats = [own.viewmat @ motion for own, motion in zip(given, motions, strict=True)]
        apart = [
            shift_px(camera, torch.linalg.inv(camera.viewmat) @ viewmat)
            for camera, viewmat in zip(cameras, viewmats, strict=True)
        ]
        return sum(apart) / 6

    before = mean_error_px([torch.eye(4, dtype=torch.float64)] * 6)
    after = mean_error_px([poses.motion(at(view)).detach() for view in range(6)])
    assert before > 1
    assert after < 0.1 * before
