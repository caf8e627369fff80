from __future__ import annotations

import numpy as np
import torch

from mrgs.prepare.rig.adjust import rigid_motion
from mrgs.prepare.rig.images import STEP_PX, InverseDepth, Plane, ReducedPair
from mrgs.prepare.rig.refine import thermal_rays, warp
from mrgs.scene import Camera
from mrgs.scene.lens import Lens

CAMERA = Camera(
    torch.tensor([[200.0, 0, 100], [0, 200.0, 80], [0, 0, 1]], dtype=torch.float64),
    torch.eye(4, dtype=torch.float64),
    200,
    160,
)
THERMAL = Lens(80, 64, 90.0, 91.0, 41.0, 31.0, (-0.2, 0.05, 0.0, 0.0))
MOTION = rigid_motion(torch.tensor([0.02, -0.03, 0.05, 0.2, -0.1, 0.05], dtype=torch.float64))


def slanted_pair(valid: np.ndarray | None = None) -> ReducedPair:
    """A photo of the plane z = 4 / (1 - y / z); its value is the column."""
    rows, columns = 160 // STEP_PX, 200 // STEP_PX
    slope = ((np.arange(rows) + 0.5) * STEP_PX - 80) / 200
    depth = InverseDepth(np.repeat((1 - slope)[:, None] / 4, columns, axis=1), 0.25)
    photo = np.tile((np.arange(200) + 0.5).astype(np.float32), (160, 1))
    return ReducedPair(
        "one", Plane(photo, valid), CAMERA, depth, Plane(np.zeros((64, 80), dtype=np.float32))
    )


def test_points_lie_on_the_ray_of_their_pixel_and_on_the_surface():
    rays = thermal_rays(THERMAL, 80, 64)
    warped = warp(slanted_pair(), rays, torch.linalg.inv(MOTION).numpy(), 1.0)
    inner = warped.seen & (np.abs(rays[..., 1]) < 0.25)
    assert inner.mean() > 0.4
    points = warped.points[inner]
    np.testing.assert_allclose(points[:, 2], 4 / (1 - points[:, 1] / points[:, 2]), rtol=2e-3)
    in_thermal = points @ MOTION[:3, :3].numpy().T + MOTION[:3, 3].numpy()
    np.testing.assert_allclose(in_thermal[:, :2] / in_thermal[:, 2:], rays[inner][:, :2], atol=1e-9)


def test_the_photo_is_sampled_where_it_shows_the_point():
    warped = warp(
        slanted_pair(), thermal_rays(THERMAL, 80, 64), torch.linalg.inv(MOTION).numpy(), 1.0
    )
    column = 200 * warped.points[..., 0] / warped.points[..., 2] + 100
    np.testing.assert_allclose(warped.values[warped.seen], column[warped.seen], atol=1e-3)


def test_pixels_beyond_the_photo_and_masked_ones_are_not_seen():
    wide = Lens(80, 64, 40.0, 40.0, 40.0, 32.0)
    still = np.eye(4)
    warped = warp(slanted_pair(), thermal_rays(wide, 80, 64), still, 1.0)
    assert not warped.seen[:, :15].any()
    assert warped.seen[32, 40]
    valid = np.ones((160, 200), dtype=bool)
    valid[:, :100] = False
    masked = warp(slanted_pair(valid), thermal_rays(wide, 80, 64), still, 1.0)
    assert not masked.seen[:, :39].any()
    assert masked.seen[32, 42]


def test_rays_of_a_resized_image_span_the_same_field():
    fine, coarse = thermal_rays(THERMAL, 80, 64), thermal_rays(THERMAL, 40, 32)
    np.testing.assert_allclose(fine.reshape(32, 2, 40, 2, 3).mean(axis=(1, 3)), coarse, atol=1e-3)
