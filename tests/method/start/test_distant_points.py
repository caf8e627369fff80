from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from mrgs.method.start.distant_points import SPACING_RAD, distant_points
from mrgs.scene import Camera
from mrgs.scene.world import TIMES_AS_FAR


def camera_towards(angle: float, distance: float = 0.0) -> Camera:
    """Looks outwards along a horizontal direction, from a place ``distance`` behind the origin; 90°
    across."""
    forward = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward])
    viewmat[2, 3] = distance
    K = torch.tensor([[48.0, 0, 48.0], [0, 48.0, 36.0], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, viewmat, 96, 72)


def wall_of(camera: Camera, rows: range, depth: float = 3.0) -> Tensor:
    """A point in the middle of each of 24 × 18 cells of the photo, in some rows."""
    column, row = torch.meshgrid(
        torch.arange(24.0), torch.tensor([float(row) for row in rows]), indexing="xy"
    )
    pixels = torch.stack([4 * column.flatten() + 2, 4 * row.flatten() + 2], dim=1).double()
    return camera.unproject(pixels, torch.full((len(pixels),), depth).double()).float()


def test_a_photo_full_of_points_gets_none_behind_them():
    camera = camera_towards(0.3)
    assert len(distant_points(wall_of(camera, range(18)), [camera]).positions) == 0


def test_the_sky_above_a_wall_gets_points_far_away():
    camera = camera_towards(0.3)
    points = wall_of(camera, range(9, 18))
    sky = distant_points(points, [camera]).positions.double()
    pixels, _ = camera.project(sky)
    assert camera.contains(pixels).all()
    assert (pixels[:, 1] < 37).all()
    assert (pixels[:, 1] > 33).any()  # as far down as to the wall
    solid_angle = (math.pi / 2) * (math.pi / 5)
    assert 0.7 * solid_angle < len(sky) * SPACING_RAD**2 < 1.5 * solid_angle
    farthest = points.norm(dim=1).max().item()
    torch.testing.assert_close(
        sky.norm(dim=1),
        torch.full((len(sky),), TIMES_AS_FAR * farthest).double(),
        rtol=0.05,
        atol=0,
    )


def test_where_the_world_has_its_origin_does_not_matter():
    camera = camera_towards(0.3)
    shift = torch.tensor([2.0, -1.0, 0.5])
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ shift.double()
    points = wall_of(camera, range(9, 18))
    sky = distant_points(points, [camera])
    moved = distant_points(points + shift, [Camera(camera.K, viewmat, 96, 72)])
    apart = torch.cdist(moved.positions - shift, sky.positions)
    assert moved.spacing == pytest.approx(sky.spacing, rel=1e-4)
    assert max(apart.amin(dim=0).max(), apart.amin(dim=1).max()) < sky.spacing


def test_a_small_gap_in_a_wall_stays_as_it_is():
    camera = camera_towards(0.3)
    points = wall_of(camera, range(18))
    pixels, _ = camera.project(points.double())
    gap = (pixels - pixels.new_tensor([44.0, 40.0])).abs().amax(dim=1) < 3
    assert gap.sum() == 4
    assert len(distant_points(points[~gap], [camera]).positions) == 0


def test_what_several_photos_see_becomes_one_point():
    cameras = [camera_towards(0.3), camera_towards(0.3, distance=0.01)]
    points = wall_of(cameras[0], range(9, 18))
    one, two = (distant_points(points, cameras[:count]).positions for count in (1, 2))
    nearest = (
        torch.cdist(two / two.norm(dim=1, keepdim=True), one / one.norm(dim=1, keepdim=True))
        .min(dim=1)
        .values
    )
    assert (nearest < 2 * SPACING_RAD).all()
    assert len(two) < 1.5 * len(one)


def test_a_hole_in_a_surface_that_other_photos_see_elsewhere_is_no_sky():
    """A part of a floor has no points, as in a shadow: in the same direction, which is far below
    it, the other cameras see other parts of the floor."""
    cameras = [camera_towards(0.0) for _ in range(4)]
    for camera, aside in zip(cameras, (0.0, 4.0, 8.0, 12.0), strict=True):
        camera.viewmat[0, 3] = aside
    side = torch.arange(0.0, 30.0, 0.2)
    floor = torch.cartesian_prod(side, torch.arange(-30.0, 30.0, 0.2), torch.tensor([-1.5]))
    whole = (floor[:, :2] - torch.tensor([4.0, 0.0])).norm(dim=1) > 1.5
    alone, agreed = (
        distant_points(floor[whole], cameras[:count]).positions for count in (1, len(cameras))
    )
    below = [(each[:, 2] < -0.15 * each[:, 0]).sum().item() for each in (alone, agreed)]
    assert below[0] > 0
    assert below[1] == 0
    assert len(agreed) > 0


def test_cameras_outside_the_points_are_inside_the_sphere():
    """As around a thing on a table: the points lie within the ring of cameras, which look
    inwards."""
    cameras = [camera_towards(angle, distance=5.0) for angle in (0.0, 2.0, 4.0)]
    points = 0.1 * torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
    found = distant_points(points, cameras).positions.double()
    centre = torch.stack([camera.position for camera in cameras]).mean(dim=0)
    assert (found - centre).norm(dim=1).min() > 0.9 * TIMES_AS_FAR * 5.0
    assert all((camera.project(found)[1] > 5.0).any() for camera in cameras)


def test_a_photo_of_few_points_does_not_tell_what_is_empty():
    camera = camera_towards(0.3)
    points = wall_of(camera, range(10, 18))
    assert len(points) == 8 * 24
    assert len(distant_points(points, [camera]).positions) == 0


@pytest.mark.parametrize("missing", ["cameras", "points"])
def test_nothing_to_go_by(missing):
    points = torch.zeros(0 if missing == "points" else 4, 3)
    found = distant_points(points, [] if missing == "cameras" else [camera_towards(0.0)])
    assert found.positions.shape == (0, 3)


def test_a_photo_of_the_ground_alone_gets_none_below_it():
    """Straight down from 3 m: the ground is bare in one half of the photo."""
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    camera = Camera(camera_towards(0.0).K, viewmat, 96, 72)
    ground = wall_of(camera, range(9))
    assert (distant_points(ground, [camera]).positions[:, 2] < -20).all()
    assert len(distant_points(ground, [camera], z_up=True).positions) == 0


def test_the_sky_stays_where_z_is_known_to_point_up():
    camera = camera_towards(0.3)
    points = wall_of(camera, range(9, 18))
    without, known = (distant_points(points, [camera], up).positions for up in (False, True))
    assert len(without) > 50
    torch.testing.assert_close(without, known)
