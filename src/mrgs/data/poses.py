"""Camera poses: their checks, and from the files' conventions to OpenCV's world to camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from mrgs.data.files import MAX_MAGNITUDE, Number, json_value, scene_error
from mrgs.scene.rotations import (
    OPENGL_FROM_OPENCV,
    ORTHONORMAL_TOLERANCE,
    ends_in_last_row,
    matrix_from_quaternion,
    nearest_rotations,
    rigid_transform,
)

_Matrix: TypeAlias = Annotated[
    list[tuple[Number, Number, Number, Number]], msgspec.Meta(min_length=3, max_length=4)
]


def matrix_from_json(value: object, what: str, file: Path) -> NDArray[np.float64]:
    """A 3×4 or 4×4 matrix from a JSON value; SceneError for another shape, entries that are not
    numbers, or numbers that are not finite or too large."""
    remedy = "it must be 3×4 or 4×4 finite numbers"
    return np.array(json_value(_Matrix, value, what, file, remedy))


def nearest_rotation(matrix: NDArray[np.float64], what: str, file: Path) -> NDArray[np.float64]:
    """The nearest rotation (by SVD); SceneError unless it is within ``ORTHONORMAL_TOLERANCE``."""
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
    """World to camera with OpenCV axes, from nerfstudio's camera to world with OpenGL axes, [3 or
    4, 4]. SceneError if it is no rigid motion."""
    rotation = nearest_rotation(camera_to_world[:3, :3], what, file)
    if not ends_in_last_row(camera_to_world):
        raise scene_error(file, f"the last row of {what} is not 0 0 0 1; correct it")
    from_world = OPENGL_FROM_OPENCV[:3, :3] @ rotation.T
    return rigid_transform(from_world, -(from_world @ camera_to_world[:3, 3]))


def viewmat_from_colmap(
    qvec: NDArray[np.float64], tvec: NDArray[np.float64], what: str, file: Path
) -> Float64[Tensor, "4 4"]:
    """World to camera from COLMAP's unit quaternion (w, x, y, z) and translation. SceneError for
    numbers that are not finite or huge, and for a quaternion whose length is not 1."""
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
