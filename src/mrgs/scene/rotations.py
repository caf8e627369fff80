"""Rotations in float64, without gradients: the exponential map of SO(3), quaternions wxyz (scalar
first), and the axes of cameras. Rotation vectors are axis times angle in radians. Tensors can be
given in place of arrays; NumPy 2.2 converts them only if asked to (``np.asarray``)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes y down, z forward (OpenCV) to y up, z back (OpenGL), [4, 4]; its own inverse."""


def rigid_transform(rotation: ArrayLike, translation: ArrayLike) -> Float64[Tensor, "4 4"]:
    """The homogeneous matrix of a rotation [3, 3] and a translation [3]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.asarray(rotation), np.asarray(translation)
    return torch.from_numpy(matrix)


def opengl_camera_to_world(viewmat: Float64[Tensor, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Nerfstudio's camera pose: camera to world with OpenGL axes."""
    rotation, translation = viewmat[:3, :3].numpy(), viewmat[:3, 3].numpy()
    return rigid_transform(rotation.T, -rotation.T @ translation).numpy() @ OPENGL_FROM_OPENCV


def matrix_from_quaternion(wxyz: ArrayLike) -> Float64[np.ndarray, "*n 3 3"]:
    """Rotation matrices of quaternions wxyz [4] or [N, 4] of any length but 0."""
    return Rotation.from_quat(np.asarray(wxyz), scalar_first=True).as_matrix()


def quaternion_from_matrix(matrix: ArrayLike) -> Float64[np.ndarray, "*n 4"]:
    """Unit quaternions wxyz of rotation matrices [3, 3] or [N, 3, 3]."""
    return Rotation.from_matrix(np.asarray(matrix)).as_quat(scalar_first=True)


def matrix_from_rotvec(rotvec: ArrayLike) -> Float64[np.ndarray, "*n 3 3"]:
    """The exponential map of SO(3) (Rodrigues' formula) of rotation vectors [3] or [N, 3]."""
    return Rotation.from_rotvec(np.asarray(rotvec)).as_matrix()


def rotvec_from_matrix(matrix: ArrayLike) -> Float64[np.ndarray, "*n 3"]:
    """The logarithm map of SO(3): rotation vectors, at most π long, of [3, 3] or [N, 3, 3]."""
    return Rotation.from_matrix(np.asarray(matrix)).as_rotvec()


def cross_matrix(v: Float64[Tensor, "*n 3"]) -> Float64[Tensor, "*n 3 3"]:
    """The skew-symmetric matrix [v]× of the cross product with v."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*v.shape, 3)


def left_jacobian(rotvec: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3 3"]:
    """The left Jacobian J of SO(3): exp(v + d) = exp(J d) exp(v) for a small d, by the series of (1
    − cos θ) / θ² and (θ − sin θ) / θ³: exact to 1e-9 for angles θ below 1."""
    t = rotvec.square().sum(dim=-1)[:, None, None]
    cosine = 0.5 - t / 24 * (1 - t / 30 * (1 - t / 56 * (1 - t / 90 * (1 - t / 132))))
    rest = 1 / 6 - t / 120 * (1 - t / 42 * (1 - t / 72 * (1 - t / 110 * (1 - t / 156))))
    cross = cross_matrix(rotvec)
    return torch.eye(3, dtype=rotvec.dtype) + cosine * cross + rest * cross @ cross


ORTHONORMAL_TOLERANCE = 1e-3
"""Largest entry of |RᵀR − I| that counts as rounding; it is then removed."""

_SINGLE = 1e-6
"""Rounding of single precision, which is left as it is."""

_IDENTITY = np.eye(3)


def checked_intrinsics(K: Float64[Tensor, "3 3"]) -> Float64[Tensor, "3 3"]:
    """A copy of the matrix of a pinhole without skew, of finite numbers. ValueError for a skew, a
    focal length that is not positive, or a last row that is not 0 0 1."""
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
    precision has is replaced by the nearest one. ValueError for scaled, sheared or mirrored axes,
    or a last row that is not 0 0 0 1."""
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
