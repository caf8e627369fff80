"""A plane in perspective."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from mrgs.scene.rotations import matrix_from_rotvec, rigid_transform, rotvec_from_matrix


def board_points(columns: int, rows: int) -> Float[np.ndarray, "n 2"]:
    """The inner corners on a board whose squares are 1 wide: x, y, row by row."""
    grid = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
    return np.stack(grid, axis=-1).reshape(-1, 2)


def homography(
    source: Float[np.ndarray, "n 2"], target: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "3 3"]:
    """The projective map of four or more points onto others, by the normalised direct linear
    transformation (Hartley and Zisserman, algorithm 4.2)."""
    (a, normal_a), (b, normal_b) = _normalised(source), _normalised(target)
    ones, zeros = np.ones((len(a), 1)), np.zeros((len(a), 3))
    lifted = np.hstack([a, ones])
    rows = np.concatenate(
        [
            np.hstack([lifted, zeros, -b[:, :1] * lifted]),
            np.hstack([zeros, lifted, -b[:, 1:] * lifted]),
        ]
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    return np.linalg.inv(normal_b) @ matrix @ normal_a


def transformed(
    matrix: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Points under a projective map."""
    lifted = np.einsum("ij,nj->ni", matrix[:, :2], points) + matrix[:, 2]
    return lifted[:, :2] / lifted[:, 2:]


def _normalised(
    points: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "3 3"]]:
    """Points about 0 at a mean distance of √2, and the map that makes them so."""
    centre = points.mean(axis=0)
    scale = np.sqrt(2) / np.linalg.norm(points - centre, axis=1).mean()
    return (points - centre) * scale, np.array(
        [[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]]
    )


def plane_pose(
    rays: Float[np.ndarray, "n 2"], plane: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "4 4"]:
    """The rigid motion from a plane's axes to the camera that sees its points (x, y, 0).

    From the homography (Zhang 2000, section 3.1), then by least squares of the distances in the
    image.

    Args:
        rays: normalised coordinates x / z and y / z in the camera.
        plane: the points, in any unit of length; the motion is in the same.
    """
    columns = homography(plane, rays)
    columns = columns / np.linalg.norm(columns[:, :2], axis=0).mean() * np.sign(columns[2, 2])
    u, _, v = np.linalg.svd(
        np.column_stack([columns[:, 0], columns[:, 1], np.cross(columns[:, 0], columns[:, 1])])
    )
    start = np.concatenate([rotvec_from_matrix(u @ v), columns[:, 2]])
    flat = np.column_stack([plane, np.zeros(len(plane))])

    def residuals(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, " k"]:
        points = flat @ matrix_from_rotvec(pose[:3]).T + pose[3:]
        return (points[:, :2] / points[:, 2:] - rays).ravel()

    pose = least_squares(residuals, start, x_scale="jac").x
    return rigid_transform(matrix_from_rotvec(pose[:3]), pose[3:]).numpy()
