"""Positions of the target's corners in the axes of each photo's camera, in scene units.

A stationary target is located by the poses of all photos that show it, which also gives the size of
its squares. A target that is moved is located by its perspective, for which the size of its squares
must be known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from mrgs.errors import SceneError
from mrgs.prepare.rig.target.detect import Corners
from mrgs.prepare.rig.target.plane import board_points, plane_pose
from mrgs.prepare.rig.target.sightings import Sighting
from mrgs.scene.rotations import matrix_from_rotvec
from mrgs.scene.view import evenly_spaced

_FEWEST = 3
_MOST_HYPOTHESES = 100
_TURNED_RAD = np.radians(10)
_ROUGH_SQUARES = 0.3
_STATIONARY_SQUARES = 0.15
_UNCERTAIN = 0.03


@dataclass(frozen=True, eq=False)
class TargetGeometry:
    """The target in space.

    Attributes:
        sightings: with the corners of the stationary ones in one common order.
        points: the corners of each sighting [N, 3], in the axes of the photo's camera, scene units.
        square: width of a square, in scene units.
        stationary: number of sightings that show the target at the same place in the world.
    """

    sightings: tuple[Sighting, ...]
    points: tuple[Float[np.ndarray, "n 3"], ...]
    square: float
    stationary: int


@dataclass(frozen=True, eq=False)
class _BoardPose:
    """A sighting, and the motion from the board's axes to those of the photo's camera, lengths in
    squares."""

    sighting: Sighting
    motion: Float[np.ndarray, "4 4"]

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Centre of projection in the world."""
        return self.sighting.camera.position.numpy()

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """From the board's axes to the world's."""
        return self.sighting.camera.viewmat[:3, :3].numpy().T @ self.motion[:3, :3]

    @property
    def offset(self) -> Float[np.ndarray, "3"]:
        """From the centre to the board's first corner, along the world's axes, in squares."""
        return self.sighting.camera.viewmat[:3, :3].numpy().T @ self.motion[:3, 3]


@dataclass(frozen=True, eq=False)
class _Board:
    """A board in the world: the corner in column i and row j is at origin + square · rotation (i,
    j, 0)."""

    rotation: Float[np.ndarray, "3 3"]
    origin: Float[np.ndarray, "3"]
    square: float

    def corners(self, plane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """In the world."""
        return self.origin + self.square * np.einsum("ij,nj->ni", self.rotation[:, :2], plane)


def localise(sightings: Sequence[Sighting], square: float | None = None) -> TargetGeometry:
    """Locate the target's corners in front of each photo.

    Each corner lies on the ray on which its photo shows it, at the depth of the board. So an error
    of the photo's pose moves it along that ray only, which hardly moves it in the image of the
    thermal camera beside it.

    Args:
        square: width of a square in scene units, if that is known.

    Raises:
        SceneError: the target is not stationary, and the width of its squares is not known.
    """
    rows, columns, _ = sightings[0].photo.grid.shape
    plane = board_points(columns, rows)
    views = [_board_poses(sighting, plane) for sighting in sightings]
    board, stationary = _stationary_board(views, plane)
    if board is None and square is None:
        raise SceneError(
            "the target cannot be used: its distance is not known. Let it stand still while it is "
            "photographed from 3 or more places; or, if it is moved, give the width of its squares "
            "and a known distance in the scene; or give no target",
            options=("target", "known_distance"),
        )
    width = square if board is None else board.square
    assert width is not None
    poses = [stationary.get(index, orderings[0]) for index, orderings in enumerate(views)]
    depths = [
        pose.sighting.camera.project(board.corners(plane))[1].numpy()
        if board is not None and index in stationary
        else width * (np.einsum("j,nj->n", pose.motion[2, :2], plane) + pose.motion[2, 3])
        for index, pose in enumerate(poses)
    ]
    points = [
        np.column_stack([pose.sighting.rays, np.ones(len(plane))]) * depth[:, None]
        for pose, depth in zip(poses, depths, strict=True)
    ]
    return TargetGeometry(
        tuple(pose.sighting for pose in poses), tuple(points), width, len(stationary)
    )


def _board_poses(sighting: Sighting, plane: Float[np.ndarray, "n 2"]) -> list[_BoardPose]:
    """The sighting in each order of its corners, with the board's pose in that order."""
    motion = plane_pose(sighting.rays, plane)
    reordered = Corners(plane.reshape(sighting.photo.grid.shape)).orderings()
    poses = []
    for ordering, corners in zip(sighting.orderings(), reordered, strict=True):
        origin = corners.grid[0, 0]
        axes = np.eye(4)
        axes[:2, :2] = np.column_stack([corners.grid[0, 1] - origin, corners.grid[1, 0] - origin])
        axes[:2, 3] = origin
        poses.append(_BoardPose(ordering, motion @ axes))
    return poses


def _stationary_board(
    views: Sequence[Sequence[_BoardPose]], plane: Float[np.ndarray, "n 2"]
) -> tuple[_Board | None, dict[int, _BoardPose]]:
    """The board at the place where most photos see it, and the poses of these photos, with their
    corners in one order; None if there are too few, or if they were taken from nearly the same
    place, which leaves the distance open."""
    couples = list(combinations(range(len(views)), 2))
    most: dict[int, _BoardPose] = {}
    for couple in evenly_spaced(len(couples), _MOST_HYPOTHESES):
        first, second = (views[index] for index in couples[couple])
        guess = _from_two(first[0], second)
        consistent = {} if guess is None else _consistent(guess, views, plane, _ROUGH_SQUARES)
        if guess is not None and len(consistent) > len(most):
            best, most = guess, consistent
    if len(most) < _FEWEST:
        return None, {}
    board, uncertainty = _fitted(best, list(most.values()), plane)
    consistent = _consistent(board, views, plane, _STATIONARY_SQUARES)
    if len(consistent) < _FEWEST or uncertainty > _UNCERTAIN:
        return None, {}
    return board, consistent


def _from_two(first: _BoardPose, second: Sequence[_BoardPose]) -> _Board | None:
    """The board that two photos see at one place; None if they do not. Their distances from it, in
    squares, follow from its perspective; the width of a square is the one for which both give the
    same place."""
    turned = max(second, key=lambda pose: float(np.trace(first.rotation.T @ pose.rotation)))
    if np.trace(first.rotation.T @ turned.rotation) < 1 + 2 * np.cos(_TURNED_RAD):
        return None
    apart = turned.offset - first.offset
    square = float((first.centre - turned.centre) @ apart / max(apart @ apart, 1e-12))
    return (
        _Board(first.rotation, first.centre + square * first.offset, square) if square > 0 else None
    )


def _consistent(
    board: _Board,
    views: Sequence[Sequence[_BoardPose]],
    plane: Float[np.ndarray, "n 2"],
    tolerance: float,
) -> dict[int, _BoardPose]:
    """The views whose reprojection error is below a share of a square, with the corners in the
    board's order."""
    corners = board.corners(plane)
    found = {}
    for index, orderings in enumerate(views):
        errors = [_reprojection_squares(pose.sighting, corners) for pose in orderings]
        if min(errors) < tolerance:
            found[index] = orderings[int(np.argmin(errors))]
    return found


def _reprojection_squares(sighting: Sighting, corners: Float[np.ndarray, "n 3"]) -> float:
    """The median reprojection error of the corners in the photo, as a share of a square."""
    pixels, _ = sighting.camera.project(corners)
    if pixels.isnan().any():  # a corner is behind the camera
        return np.inf
    errors_px = np.linalg.norm(pixels.numpy() - sighting.photo.pixels, axis=1)
    return float(np.median(errors_px) / np.median(sighting.photo.spacing))


def _fitted(
    board: _Board, poses: Sequence[_BoardPose], plane: Float[np.ndarray, "n 2"]
) -> tuple[_Board, float]:
    """The board with the least reprojection error, and its uncertainty: one standard deviation of
    the width of a square, as a share of it."""
    rotations = np.stack([pose.sighting.camera.viewmat[:3, :3].numpy() for pose in poses])
    shifts = np.stack([pose.sighting.camera.viewmat[:3, 3].numpy() for pose in poses])
    seen = np.stack([pose.sighting.rays for pose in poses])

    def moved(step: Float[np.ndarray, "7"]) -> _Board:
        turn = matrix_from_rotvec(step[:3])
        return _Board(
            turn @ board.rotation,
            board.origin + board.square * step[3:6],
            board.square * float(np.exp(step[6])),
        )

    def residuals(step: Float[np.ndarray, "7"]) -> Float[np.ndarray, " k"]:
        inside = np.einsum("vij,nj->vni", rotations, moved(step).corners(plane)) + shifts[:, None]
        return (inside[..., :2] / inside[..., 2:] - seen).ravel()

    scale = float(np.median(np.abs(residuals(np.zeros(7))))) + 1e-9
    fit = least_squares(residuals, np.zeros(7), loss="soft_l1", f_scale=scale)
    variance = float(np.mean(fit.fun**2))
    return moved(fit.x), float(
        np.sqrt(variance * np.linalg.pinv(np.einsum("ka,kb->ab", fit.jac, fit.jac))[6, 6])
    )
