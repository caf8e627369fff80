from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.prepare.rig.adjust import (
    LENS,
    POSE,
    ThermalCameras,
    lens_parameters,
    motion_parameters,
    project,
    project_jacobian,
    rigid_motion,
)
from mrgs.scene.lens import Lens

LENS_OF_TEST = Lens(640, 480, 644.4, 643.3, 304.6, 262.9, (-0.4, 0.37, 0.0, 0.0))

small = st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6)


def rig_of(lens: Lens, motion: torch.Tensor) -> torch.Tensor:
    return torch.cat([lens_parameters(lens), motion])


@given(small)
@settings(max_examples=30, deadline=None)
def test_motion_parameters_invert_rigid_motion(numbers):
    parameters = torch.tensor(numbers, dtype=torch.float64)
    assert torch.allclose(motion_parameters(rigid_motion(parameters)), parameters, atol=1e-9)


@given(small, small)
@settings(max_examples=20, deadline=None)
def test_project_is_the_lens_after_both_motions(rig_motion, own_motion):
    own = torch.tensor(own_motion, dtype=torch.float64) / 5
    rig = rig_of(LENS_OF_TEST, torch.tensor(rig_motion, dtype=torch.float64))
    points = torch.tensor([[0.3, -0.2, 4.0], [-1.0, 0.5, 6.0]], dtype=torch.float64)
    cameras = ThermalCameras(rig, own[None])
    matrix = cameras.correction(0) @ cameras.extrinsics()
    x, y, z = (points @ matrix[:3, :3].T + matrix[:3, 3]).numpy().T
    lens = cameras.lens(640, 480)
    u, v = lens.distort(x / z, y / z)
    expected = np.column_stack([u * lens.fx + lens.cx, v * lens.fy + lens.cy])
    found = project(rig, own.repeat(2, 1), points)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-6)


def test_a_lens_survives_its_parameters():
    cameras = ThermalCameras(
        rig_of(LENS_OF_TEST, torch.zeros(6, dtype=torch.float64)), torch.zeros(1, 6).double()
    )
    lens = cameras.lens(640, 480)
    for name in ("fx", "fy", "cx", "cy", "radial"):
        np.testing.assert_allclose(getattr(lens, name), getattr(LENS_OF_TEST, name), rtol=1e-12)


def test_jacobian_matches_differences():
    rig = rig_of(
        LENS_OF_TEST, torch.tensor([0.01, 0.03, -0.02, 0.1, 0.02, 0.05], dtype=torch.float64)
    )
    motion = torch.full((1, 6), 0.002, dtype=torch.float64)
    point = torch.tensor([[0.4, -0.3, 3.0]], dtype=torch.float64)
    by_rig, by_motion = project_jacobian(rig, motion, point).split([12, 6], dim=2)
    step = 1e-6
    for index in range(12):
        moved = torch.zeros(12, dtype=torch.float64)
        moved[index] = step
        slope = (project(rig + moved, motion, point) - project(rig - moved, motion, point)) / (
            2 * step
        )
        assert torch.allclose(slope, by_rig[..., index], rtol=1e-4, atol=1e-4)
    for index in range(6):
        moved = torch.zeros(1, 6, dtype=torch.float64)
        moved[0, index] = step
        slope = (project(rig, motion + moved, point) - project(rig, motion - moved, point)) / (
            2 * step
        )
        assert torch.allclose(slope, by_motion[..., index], rtol=1e-4, atol=1e-4)


def test_lens_and_pose_fill_the_rig():
    assert (LENS.stop, POSE.start, POSE.stop) == (6, 6, 12)
