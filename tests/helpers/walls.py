"""A flat wall whose temperature and depth are known exactly, in place of a model."""

from __future__ import annotations

import torch

from mrgs.scene import THERMAL, Blend, Camera, Rendering, TemperatureRange

RANGE = TemperatureRange(0.0, 40.0)


def wall_celsius(points: torch.Tensor) -> torch.Tensor:
    """°C of points of the wall [..., 3]: 20 at the middle, 2 more per metre to the right, 1 per
    metre up."""
    return 20.0 + 2.0 * points[..., 0] + points[..., 2]


def render_wall(camera: Camera) -> Rendering:
    """The wall y = 0, seen from anywhere; it ends 3 m left and right of the middle."""
    columns = torch.arange(camera.width).double() + 0.5
    rows = torch.arange(camera.height).double() + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    ray = camera.unproject(torch.stack([u, v], dim=-1), torch.ones(u.shape).double())
    ray = ray - camera.position
    depth = -camera.position[1] / ray[..., 1]
    points = camera.position + depth[..., None] * ray
    seen = (depth > 0) & (points[..., 0].abs() <= 3)
    image = RANGE.from_celsius(torch.where(seen, wall_celsius(points), 0.0))[..., None]
    alpha = seen.double()
    return Rendering({THERMAL: Blend(image, depth.where(seen, torch.zeros(())) * alpha, alpha)})


def camera_before_wall(x: float = 0.0, distance: float = 5.0) -> Camera:
    """Stands before the wall and looks at its middle."""
    return Camera.from_fov(160, 120, 60.0).look_at([x, -distance, 0.0], [0.0, 0.0, 0.0])
