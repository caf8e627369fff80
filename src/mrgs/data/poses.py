"""Camera poses: validation, and the way from the files' conventions to OpenCV's world-to-camera
matrices."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from mrgs.data.files import MAX_MAGNITUDE, scene_error
from mrgs.scene.rotations import (
    OPENGL_FROM_OPENCV,
    ORTHONORMAL_TOLERANCE,
    ends_in_last_row,
    matrix_from_quaternion,
    nearest_rotations,
    rigid_transform,
)
from mrgs.system.wording import shown


def matrix_from_json(
    value: object, rows: tuple[int, ...], what: str, file: Path
) -> NDArray[np.float64]:
    """A matrix of four columns from a JSON value.

    Raises:
        SceneError: another shape, entries that are not numbers, or numbers that are not finite or
            too large.
    """
    shape_is_right = (
        isinstance(value, list)
        and len(value) in rows
        and all(isinstance(row, list) and len(row) == 4 for row in value)
    )
    if not shape_is_right:
        expected = " or ".join(f"{count}×4" for count in rows)
        raise scene_error(file, f"{what} is {shown(value)}, not a {expected} matrix; correct it")
    assert isinstance(value, list)
    entries = [entry for row in value for entry in row]
    if not {type(entry) for entry in entries} <= {int, float}:
        raise scene_error(file, f"{what} holds something that is not a number; correct it")
    # A comparison, not a conversion: an integer in a JSON file may be too large for a float. NaN
    # fails it too.
    if not all(-MAX_MAGNITUDE <= entry <= MAX_MAGNITUDE for entry in entries):
        raise scene_error(
            file, f"{what} holds NaN, infinity or a huge number; correct it or remove the frame"
        )
    return np.array(entries, dtype=np.float64).reshape(-1, 4)


def nearest_rotation(matrix: NDArray[np.float64], what: str, file: Path) -> NDArray[np.float64]:
    """The rotation nearest to a 3×3 matrix (by SVD).

    Raises:
        SceneError: the matrix is not a rotation within ``ORTHONORMAL_TOLERANCE``.
    """
    rotations, is_rotation = nearest_rotations(matrix[None])
    if not is_rotation[0]:
        raise scene_error(
            file,
            f"{what} is not a rotation and a translation (scaled, sheared or mirrored axes); "
            f"correct it",
        )
    return rotations[0]


def viewmat_from_opengl(
    camera_to_world: NDArray[np.float64], what: str, file: Path
) -> Float64[Tensor, "4 4"]:
    """World to camera with OpenCV axes, from nerfstudio's camera to world with OpenGL axes ([3 or
    4, 4]).

    Raises:
        SceneError: not a rigid motion.
    """
    (viewmat,) = viewmats_from_opengl([camera_to_world])
    if viewmat is None:
        nearest_rotation(camera_to_world[:3, :3], what, file)
        raise scene_error(file, f"the last row of {what} is not 0 0 0 1; correct it")
    return viewmat


def viewmats_from_opengl(
    cameras_to_world: Sequence[NDArray[np.float64]],
) -> list[Float64[Tensor, "4 4"] | None]:
    """``viewmat_from_opengl`` of many matrices at once, which is much faster; None for those that
    it would refuse."""
    if not cameras_to_world:
        return []
    given = np.stack([matrix[:3] for matrix in cameras_to_world])
    rotations, is_rotation = nearest_rotations(given[:, :, :3])
    from_world = OPENGL_FROM_OPENCV[:3, :3] @ rotations.transpose(0, 2, 1)
    translations = -(from_world @ given[:, :, 3:])[:, :, 0]
    # Each in memory of its own: one camera that is kept must not keep all the others.
    return [
        rigid_transform(rotation, translation) if rigid and ends_in_last_row(matrix) else None
        for rotation, translation, rigid, matrix in zip(
            from_world, translations, is_rotation, cameras_to_world, strict=True
        )
    ]


def viewmat_from_colmap(
    qvec: NDArray[np.float64], tvec: NDArray[np.float64], what: str, file: Path
) -> Float64[Tensor, "4 4"]:
    """World to camera from COLMAP's unit quaternion (w, x, y, z) and translation.

    Raises:
        SceneError: not finite, huge, or the quaternion's length is not 1 within the tolerance.
    """
    if not (np.abs(tvec) <= MAX_MAGNITUDE).all() or not (np.abs(qvec) <= 2).all():
        raise scene_error(
            file, f"the pose of {what} holds NaN, infinity or a huge number; run COLMAP again"
        )
    norm = np.linalg.norm(qvec)
    if abs(norm - 1) > ORTHONORMAL_TOLERANCE:
        raise scene_error(
            file, f"the quaternion of {what} has length {norm:.4g}, not 1; run COLMAP again"
        )
    return rigid_transform(matrix_from_quaternion(qvec), tvec)
