from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.scene.rotations import (
    OPENGL_FROM_OPENCV,
    cross_matrix,
    left_jacobian,
    matrix_from_quaternion,
    matrix_from_rotvec,
    opengl_camera_to_world,
    quaternion_from_matrix,
    rigid_transform,
    rotvec_from_matrix,
)

rotvecs = st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3).map(np.array)


@given(rotvecs)
def test_the_exponential_map_is_that_of_the_cross_matrix(rotvec):
    expected = torch.linalg.matrix_exp(cross_matrix(torch.from_numpy(rotvec)))
    np.testing.assert_allclose(matrix_from_rotvec(rotvec), expected, atol=1e-12)


@given(rotvecs)
def test_the_logarithm_map_inverts_the_exponential_map(rotvec):
    np.testing.assert_allclose(rotvec_from_matrix(matrix_from_rotvec(rotvec)), rotvec, atol=1e-9)


@given(rotvecs)
def test_quaternions_are_scalar_first_and_invert(rotvec):
    matrix = matrix_from_rotvec(rotvec)
    wxyz = quaternion_from_matrix(matrix)
    assert abs(wxyz[0]) == pytest.approx(abs(np.cos(np.linalg.norm(rotvec) / 2)), abs=1e-9)
    np.testing.assert_allclose(matrix_from_quaternion(3 * wxyz), matrix, atol=1e-12)


@given(rotvecs.map(lambda v: 0.35 * v), rotvecs)
def test_left_jacobian_matches_differences(rotvec, direction):
    step = 1e-6 * direction
    jacobian = left_jacobian(torch.from_numpy(rotvec)[None])[0].numpy()
    moved = matrix_from_rotvec(rotvec + step) @ matrix_from_rotvec(rotvec - step).T
    np.testing.assert_allclose(rotvec_from_matrix(moved) / 2e-6, jacobian @ direction, atol=1e-6)


@given(rotvecs, rotvecs)
def test_the_opengl_pose_is_a_rotation_that_looks_along_minus_z(rotvec, translation):
    viewmat = rigid_transform(matrix_from_rotvec(rotvec), translation)
    pose = opengl_camera_to_world(viewmat)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose) == pytest.approx(1)
    np.testing.assert_allclose(-pose[:3, 2], viewmat[2, :3], atol=1e-12)
    np.testing.assert_allclose(OPENGL_FROM_OPENCV @ np.linalg.inv(pose), viewmat, atol=1e-12)
