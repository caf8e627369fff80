from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.prepare.rig.adjust import rigid_motion
from mrgs.prepare.rig.chessboard import homography, transformed
from mrgs.prepare.rig.target import plane_pose

PLANE = np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
small = st.lists(st.floats(-0.6, 0.6), min_size=3, max_size=3)


@given(small, small)
@settings(max_examples=15, deadline=None)
def test_the_pose_of_a_plane_is_found(turn, place):
    motion = rigid_motion(
        torch.tensor([*turn, *(np.array(place) - (2.5, 2.0, -9.0))], dtype=torch.float64)
    ).numpy()
    points = PLANE @ motion[:3, :2].T + motion[:3, 3]
    found = plane_pose(points[:, :2] / points[:, 2:], PLANE)
    np.testing.assert_allclose(found, motion, atol=1e-5)


def test_a_homography_maps_its_points():
    matrix = np.array([[1.2, 0.1, 30], [-0.2, 0.9, 50], [0.01, -0.02, 1]])
    found = homography(PLANE[:9], transformed(matrix, PLANE[:9]))
    np.testing.assert_allclose(transformed(found, PLANE), transformed(matrix, PLANE), rtol=1e-7)
