from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from mrgs.data.cameras import (
    nearest_rotation,
    viewmat_from_colmap,
    viewmat_from_opengl,
)
from mrgs.errors import SceneError

FILE = Path("transforms.json")
vectors = arrays(np.float64, 3, elements=st.floats(-100, 100))
rotations = vectors.map(lambda v: Rotation.from_rotvec(v / 30).as_matrix())


@given(rotations, vectors, vectors)
def test_opengl_poses_keep_every_point_in_place(rotation, position, point):
    """A point given in OpenGL camera axes lands at the same place with y and z flipped."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    viewmat = viewmat_from_opengl(pose, "pose", FILE).numpy()
    world = rotation @ point + position
    np.testing.assert_allclose(
        viewmat[:3, :3] @ world + viewmat[:3, 3], point * [1, -1, -1], atol=1e-9
    )
    np.testing.assert_array_equal(viewmat[3], [0, 0, 0, 1])
    assert np.linalg.det(viewmat[:3, :3]) > 0
    np.testing.assert_allclose(
        viewmat_from_opengl(pose[:3], "pose", FILE).numpy(),
        viewmat,
        atol=0,
        err_msg="3×4 and 4×4 mean the same",
    )


@given(rotations, vectors)
def test_colmap_poses_agree_with_scipy(rotation, translation):
    qvec = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    viewmat = viewmat_from_colmap(qvec, translation, "image", FILE).numpy()
    np.testing.assert_allclose(viewmat[:3, :3], rotation, atol=1e-12)
    np.testing.assert_array_equal(viewmat[:3, 3], translation)


@given(rotations, arrays(np.float64, (3, 3), elements=st.floats(-1e-4, 1e-4)))
def test_rounding_is_removed(rotation, noise):
    mended = nearest_rotation(rotation + noise, "pose", FILE)
    np.testing.assert_allclose(mended.T @ mended, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(mended, rotation, atol=1e-3)


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.01, 1, 1]), np.diag([1.0, 1, -1]), np.full((3, 3), np.nan), np.zeros((3, 3))],
)
def test_what_is_no_rotation_is_refused(matrix):
    with pytest.raises(SceneError, match=r"transforms\.json: pose 3"):
        nearest_rotation(matrix, "pose 3", FILE)
