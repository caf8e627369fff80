from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.check.photos import agreements, jump
from mrgs.scene import THERMAL, Camera, PointCloud

CAMERA = Camera(
    torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], dtype=torch.float64),
    torch.eye(4, dtype=torch.float64),
    64,
    48,
)
RAMP = np.tile(np.linspace(10.0, 30.0, 64), (48, 1))


def points(count: int = 200) -> PointCloud:
    """Points of a wall at depth 3, all inside the image."""
    places = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [2.8, 2.0]
    )
    positions = torch.cat([places - torch.tensor([1.4, 1.0]), torch.full((count, 1), 3.0)], dim=1)
    return PointCloud(positions, torch.zeros(count, 3))


@pytest.mark.parametrize(("gain", "shift_c"), [(1.5, 0.0), (1.0, 4.0), (0.6, -3.0)])
def test_gain_and_offset_of_one_image_are_found(gain, shift_c):
    images = [RAMP, RAMP, RAMP, 20 + gain * (RAMP - 20) + shift_c, RAMP]
    found = agreements(images, [CAMERA] * 5, points())
    assert [agreement.jumps for agreement in found] == [False, False, False, True, False]
    assert found[3].corrected < 0.01 < found[3].error


def test_noise_is_no_jump():
    rng = np.random.default_rng(0)
    images = [RAMP + rng.normal(0, 1.5, RAMP.shape) for _ in range(6)]
    assert not any(agreement.jumps for agreement in agreements(images, [CAMERA] * 6, points()))


def test_images_that_share_too_little_are_not_judged():
    images = [RAMP, RAMP, RAMP, np.full_like(RAMP, np.nan), None]
    found = agreements(images, [CAMERA, CAMERA, CAMERA, CAMERA, None], points())
    assert [agreement is None for agreement in found] == [False, False, False, True, True]
    assert agreements(images, [CAMERA] * 5, points(10)) == [None] * 5
    assert agreements([RAMP, RAMP], [CAMERA] * 2, points()) == [None] * 2


@pytest.mark.parametrize(("radiometric", "severity"), [(True, "note"), (False, "warning")])
def test_drift_of_radiometric_photos_stops_nothing(radiometric, severity):
    problem = jump(THERMAL, ["a", "b"], radiometric)
    assert (problem.severity, "offset" in problem.remedy) == (severity, radiometric)
