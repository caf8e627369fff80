"""Rotations in float64: the exponential map of SO(3), quaternions, and the axes of cameras.

Rotation vectors are axis times angle in radians; quaternions are wxyz (scalar first). Nothing here
carries gradients: the rasterizer and density control rotate Gaussians with torch. Tensors are taken
where arrays are; NumPy 2.2 converts them only when it is asked to (``np.asarray``).
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from torch import Tensor

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes x right, y down, z forward (OpenCV) to x right, y up, z backward (OpenGL), [4, 4].
It is its own inverse."""


def rigid_transform(rotation: ArrayLike, translation: ArrayLike) -> Float64[Tensor, "4 4"]:
    """The homogeneous matrix of a rotation [3, 3] and a translation [3]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.asarray(rotation), np.asarray(translation)
    return torch.from_numpy(matrix)


def opengl_camera_to_world(viewmat: Float64[Tensor, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Nerfstudio's camera pose: camera to world with OpenGL axes.

    Args:
        viewmat: world to camera with OpenCV axes.
    """
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
    """The left Jacobian J of SO(3): exp(v + d) = exp(J d) exp(v) for a small d.

    By the series of (1 − cos θ) / θ² and (θ − sin θ) / θ³: smooth at 0, and exact to 1e-9 for
    angles θ below 1.
    """
    t = rotvec.square().sum(dim=-1)[:, None, None]
    cosine = 0.5 - t / 24 * (1 - t / 30 * (1 - t / 56 * (1 - t / 90 * (1 - t / 132))))
    rest = 1 / 6 - t / 120 * (1 - t / 42 * (1 - t / 72 * (1 - t / 110 * (1 - t / 156))))
    cross = cross_matrix(rotvec)
    return torch.eye(3, dtype=rotvec.dtype) + cosine * cross + rest * cross @ cross
