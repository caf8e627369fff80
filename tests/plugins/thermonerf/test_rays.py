from __future__ import annotations

import math

import torch

from mrgs.scene import Camera
from mrgs_thermonerf.rays import CameraRays, SceneFrame


def some_camera(width: int, height: int, angle: float) -> Camera:
    K = torch.tensor(
        [[1.3 * width, 0, 0.45 * width], [0, 1.7 * height, 0.6 * height], [0, 0, 1]],
        dtype=torch.float64,
    )
    c, s = math.cos(angle), math.sin(angle)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([0.2, -0.3, 4.0])
    return Camera(K, viewmat, width, height)


def test_rays_pass_through_the_centres_of_their_pixels():
    cameras = [some_camera(7, 5, 0.3), some_camera(4, 6, -1.0)]
    frame = SceneFrame(torch.tensor([0.5, 1.0, -2.0], dtype=torch.float64), 2.5, 0.1, 1.0, 10.0)
    rays = CameraRays(cameras, frame)
    assert len(rays) == 35 + 24
    through = rays.through(torch.arange(len(rays)))
    torch.testing.assert_close(through.directions.norm(dim=1), torch.ones(len(rays)))
    distance = 3.0
    points = (
        frame.centre + frame.radius * (through.origins + distance * through.directions).double()
    )
    start = 0
    for camera in cameras:
        count = camera.width * camera.height
        in_camera = points[start : start + count] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        projected = in_camera @ camera.K.T
        pixels = projected[:, :2] / projected[:, 2:]
        rows, columns = torch.meshgrid(
            torch.arange(camera.height), torch.arange(camera.width), indexing="ij"
        )
        expected = torch.stack([columns.flatten(), rows.flatten()], dim=1) + 0.5
        torch.testing.assert_close(pixels, expected.double(), rtol=0, atol=1e-4)
        z_depth = distance * frame.radius * through.cosines[start : start + count].double()
        torch.testing.assert_close(in_camera[:, 2], z_depth, rtol=1e-5, atol=1e-5)
        start += count
