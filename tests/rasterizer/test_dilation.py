from __future__ import annotations

import pytest
import torch

from mrgs.rasterizer.contract import LEAST_DILATION_PX2, Dilation
from mrgs.scene import Camera


def camera_of(fx: float, fy: float) -> Camera:
    K = torch.tensor([[fx, 0.0, 20.0], [0.0, fy, 15.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(K, torch.eye(4, dtype=torch.float64), 40, 30)


@pytest.mark.parametrize("focal_px", [10.0, 100.0, 1_000.0])
def test_as_published_it_is_the_same_for_every_camera(focal_px):
    assert Dilation().of(camera_of(focal_px, focal_px)) == 0.3


@pytest.mark.parametrize(
    ("fx", "fy", "expected"),
    [
        (100.0, 100.0, 0.1),
        (400.0, 400.0, 0.1),  # finer than the photos
        (50.0, 50.0, 0.1 / 4),  # pixels twice as wide
        (200.0, 12.5, 0.1 / 4),  # pixels four times as large
        (1.0, 1.0, LEAST_DILATION_PX2),
    ],
)
def test_where_pixels_are_larger_it_is_as_wide_in_angle(fx, fy, expected):
    assert Dilation(0.1, finest_focal_px=100.0).of(camera_of(fx, fy)) == pytest.approx(expected)
