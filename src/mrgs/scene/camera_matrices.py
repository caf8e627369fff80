"""What the matrices of a pinhole camera must be, whoever gives them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

ORTHONORMAL_TOLERANCE = 1e-3
"""Largest entry of |RᵀR − I| that counts as rounding; it is then removed."""

_SINGLE = 1e-6
"""Rounding of single precision, which is left as it is."""

_IDENTITY = np.eye(3)


def checked_intrinsics(K: Float64[Tensor, "3 3"]) -> Float64[Tensor, "3 3"]:
    """A copy of the matrix of a pinhole without skew, of finite numbers.

    Raises:
        ValueError: a skew, a focal length that is not positive, or a last row that is not 0 0 1.
    """
    (fx, skew, _), (below, fy, _), last_row = K.tolist()
    if not _is_close(last_row, (0.0, 0.0, 1.0)):
        raise ValueError(
            f"the last row of K is {_listed(last_row)}, not 0 0 1: give "
            f"[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
        )
    if not (fx > 0 and fy > 0):
        raise ValueError(f"the focal lengths in K must be above 0, not {_listed((fx, fy))}")
    if max(abs(skew), abs(below)) > _SINGLE * min(fx, fy):
        raise ValueError(
            f"K has a skew (K[0, 1] = {skew:g}, K[1, 0] = {below:g}), which is not supported: "
            f"resample the images to a camera without skew"
        )
    return K.clone()


def checked_pose(viewmat: Float64[Tensor, "4 4"]) -> Float64[Tensor, "4 4"]:
    """A copy of a rigid motion of finite numbers; a rotation with fewer digits than single
    precision has is replaced by the nearest one.

    Raises:
        ValueError: scaled, sheared or mirrored axes, or a last row that is not 0 0 0 1.
    """
    copy = viewmat.clone()
    entries = copy.numpy()
    if not ends_in_last_row(entries):
        raise ValueError(
            f"the last row of viewmat is {_listed(entries[3].tolist())}, not 0 0 0 1: give the "
            f"matrix that takes world to camera, with the translation in its last column"
        )
    rotation = entries[:3, :3]
    if _deviations(rotation).max() > _SINGLE or np.linalg.det(rotation) < 0:
        nearest, is_rotation = nearest_rotations(rotation[None])
        if not is_rotation[0]:
            raise ValueError(
                "viewmat is not a rotation and a translation (scaled, sheared or mirrored axes)"
            )
        rotation[:] = nearest[0]
    return copy


def nearest_rotations(
    matrices: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The rotations nearest to matrices [N, 3, 3] (by SVD), and which of these are rotations within
    ``ORTHONORMAL_TOLERANCE``; the others' results mean nothing."""
    is_near = _deviations(matrices).max(axis=(1, 2)) <= ORTHONORMAL_TOLERANCE
    usable = np.where(is_near[:, None, None], matrices, _IDENTITY)
    left, _, right = np.linalg.svd(usable)
    return left @ right, is_near & (np.linalg.det(usable) > 0)


def ends_in_last_row(matrix: NDArray[np.float64]) -> bool:
    """Whether a matrix [3 or 4, 4] has no fourth row, or 0 0 0 1."""
    return len(matrix) < 4 or _is_close(matrix[3].tolist(), (0.0, 0.0, 0.0, 1.0))


def _deviations(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """|RᵀR − I| of matrices [..., 3, 3]."""
    return np.abs(matrices.swapaxes(-1, -2) @ matrices - _IDENTITY)


def _is_close(have: Sequence[float], want: Sequence[float]) -> bool:
    return all(abs(one - other) <= _SINGLE for one, other in zip(have, want, strict=True))


def _listed(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:g}" for number in numbers)
