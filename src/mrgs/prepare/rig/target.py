"""A chessboard that both cameras see, located in space, as observations for the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares

from mrgs.errors import SceneError
from mrgs.prepare.contract import Progress
from mrgs.prepare.rig.adjust import Adjusted, Observations
from mrgs.prepare.rig.chessboard import Corners, board_points, detect_chessboard, homography
from mrgs.prepare.rig.contract import ChessboardTarget, RigPair, TargetFit
from mrgs.prepare.rig.images import grey_plane
from mrgs.prepare.rig.search import Guess
from mrgs.scene import Camera
from mrgs.scene.rotations import matrix_from_rotvec, rigid_transform, rotvec_from_matrix
from mrgs.scene.similarity import fit_similarity
from mrgs.scene.view import evenly_spaced

Coordinates: TypeAlias = Float[np.ndarray, "n 2"]

CORNERS = 1
"""The kind of a target's corners among observations; patches are 0."""

_FEWEST = 3
_MOST_HYPOTHESES = 100
_TURNED_RAD = np.radians(10)
_ROUGH_SQUARES = 0.3
_STATIONARY_SQUARES = 0.15
_UNCERTAIN = 0.03


@dataclass(frozen=True, eq=False)
class Sighting:
    """The target in the images of a pair: the photo's camera, the corners in the photo, and the
    same corners, in the same order, in the thermal image; None if it does not show them."""

    name: str
    camera: Camera
    photo: Corners
    thermal: Corners | None

    @property
    def rays(self) -> Coordinates:
        """x / z and y / z of the corners, in the axes of the photo's camera."""
        K = self.camera.K.numpy()
        return (self.photo.pixels - K[:2, 2]) / K[[0, 1], [0, 1]]

    def orderings(self) -> list[Sighting]:
        """The sighting in each order of the corners that looks the same."""
        photos = self.photo.orderings()
        thermals = [None] * len(photos) if self.thermal is None else self.thermal.orderings()
        both = zip(photos, thermals, strict=True)
        return [Sighting(self.name, self.camera, photo, thermal) for photo, thermal in both]


@dataclass(frozen=True, eq=False)
class LocatedTarget:
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

    def world_points(self, name: str) -> Float[np.ndarray, "k 3"]:
        """The corners in the photo of a pair, in the world; none if it does not show the target."""
        for sighting, points in zip(self.sightings, self.points, strict=True):
            if sighting.name == name:
                viewmat = sighting.camera.viewmat.numpy()
                return np.einsum("ji,nj->ni", viewmat[:3, :3], points - viewmat[:3, 3])
        return np.zeros((0, 3))

    def observations(self, names: Sequence[str]) -> Observations:
        """The corners in the thermal images; ``names`` are those of the pairs, in the order in
        which the cameras are counted."""
        views, points, pixels = [], [np.zeros((0, 3))], [np.zeros((0, 2))]
        for sighting, corners in zip(self.sightings, self.points, strict=True):
            if sighting.thermal is not None and sighting.name in names:
                views += [list(names).index(sighting.name)] * len(corners)
                points.append(corners)
                pixels.append(sighting.thermal.pixels.astype(np.float64))
        return Observations(
            views=torch.tensor(views, dtype=torch.int64),
            points=torch.from_numpy(np.concatenate(points)),
            pixels=torch.from_numpy(np.concatenate(pixels)),
            information=torch.eye(2, dtype=torch.float64).repeat(len(views), 1, 1),
            independent=torch.ones(len(views), dtype=torch.float64),
            kinds=torch.full((len(views),), CORNERS),
        )

    def guess(self, width: int, height: int) -> Guess:
        """The focal length, rotation and shift that map the corners of the photos best to those of
        the thermal images."""
        both = [(s.rays, s.thermal.pixels) for s in self.sightings if s.thermal is not None]
        rays, pixels = (np.concatenate(parts) for parts in zip(*both, strict=True))
        found = fit_similarity(rays, pixels)
        right, down = (found.translation - np.array([width, height]) / 2) / width
        turn_deg = -float(np.degrees(np.arctan2(found.rotation[1, 0], found.rotation[0, 0])))
        return Guess(1.0, found.scale / width, turn_deg, (float(right), float(down)))

    def fit(
        self, adjusted: Adjusted, observations: Observations, square_m: float | None
    ) -> TargetFit:
        """Reprojection errors of the corners in the adjusted cameras; and the scale, if the target
        is stationary and the width of its squares is known."""
        residuals = adjusted.residual_px[observations.kinds == CORNERS]
        if not len(residuals):
            residuals = torch.full((1,), torch.nan)
        return TargetFit(
            sum(sighting.thermal is not None for sighting in self.sightings),
            (float(residuals.quantile(0.5)), float(residuals.quantile(0.9))),
            None if square_m is None or not self.stationary else square_m / self.square,
        )


def find_target(
    pairs: Sequence[RigPair],
    target: ChessboardTarget,
    metres_per_unit: float | None,
    report: Progress,
) -> LocatedTarget:
    """Detect a target in all pairs and locate its corners. SceneError if no pair shows it in both
    images, its distance is ambiguous, or an image cannot be read. Both have the same side up."""
    found, in_thermal = [], 0
    for index, pair in enumerate(pairs):
        report("looking for the target", index, len(pairs))
        photo = detect_chessboard(grey_plane(pair.photo.load(), pair.name).values, target.inner)
        thermal = detect_chessboard(grey_plane(pair.load_thermal(), pair.name).values, target.inner)
        in_thermal += thermal is not None
        if photo is not None:
            if thermal is not None:  # in the photo's order: least rotation between the images
                centred = photo.pixels - photo.pixels.mean(axis=0)
                likeness = [(centred * each.pixels).sum() for each in thermal.orderings()]
                thermal = thermal.orderings()[int(np.argmax(likeness))]
            found.append(Sighting(pair.name, pair.photo.camera, photo, thermal))
    if not any(sighting.thermal is not None for sighting in found):
        columns, rows = target.inner
        raise SceneError(
            f"no pair shows the chessboard of {columns}×{rows} inner corners in both images (it "
            f"was found in {len(found)} photos and {in_thermal} thermal images of {len(pairs)}): "
            f"check the counts, which are of the corners where four squares meet and not of the "
            f"squares, or give no target",
            options=("target",),
        )
    square = None
    if target.square_m is not None and metres_per_unit is not None:
        square = target.square_m / metres_per_unit
    return localise(found, square)


class _BoardPose(NamedTuple):
    """A sighting, and the motion from the board's axes to its photo's camera, in squares."""

    sighting: Sighting
    motion: Float[np.ndarray, "4 4"]

    @property
    def in_world(self) -> Float[np.ndarray, "3 4"]:
        """The board's axes in the world, and its first corner from the centre of projection along
        the world's axes, in squares."""
        return self.sighting.camera.viewmat[:3, :3].numpy().T @ self.motion[:3]


class _Board(NamedTuple):
    """A board in the world: corner (i, j) is at origin + square · rotation (i, j, 0)."""

    rotation: Float[np.ndarray, "3 3"]
    origin: Float[np.ndarray, "3"]
    square: float

    def corners(self, plane: Coordinates) -> Float[np.ndarray, "n 3"]:
        return self.origin + self.square * np.einsum("ij,nj->ni", self.rotation[:, :2], plane)


def localise(sightings: Sequence[Sighting], square: float | None = None) -> LocatedTarget:
    """Locate the target's corners in front of each photo: a stationary one by all photos' poses,
    which gives the width of its squares; a moved one by its perspective. Each corner is placed on
    its photo's own ray at the board's depth, so that an error of the pose hardly moves it in the
    thermal image taken with the photo. ``square`` is the width of a square in scene units;
    SceneError if it is None and the target is moved."""
    rows, columns, _ = sightings[0].photo.grid.shape
    plane = board_points(columns, rows)
    views = [
        [_BoardPose(each, plane_pose(each.rays, plane)) for each in sighting.orderings()]
        for sighting in sightings
    ]
    board, stationary = _stationary_board(views, plane)
    width = square if board is None else board.square
    if width is None:
        raise SceneError(
            "the target cannot be used: its distance is not known. Let it stand still while it is "
            "photographed from 3 or more places; or, if it is moved, give the width of its squares "
            "and a known distance in the scene; or give no target",
            options=("target", "known_distance"),
        )
    located, points = [], []
    for index, orderings in enumerate(views):
        pose = stationary.get(index, orderings[0])
        if board is not None and index in stationary:
            depth = pose.sighting.camera.project(board.corners(plane))[1].numpy()
        else:
            depth = width * (np.einsum("j,nj->n", pose.motion[2, :2], plane) + pose.motion[2, 3])
        located.append(pose.sighting)
        points.append(np.column_stack([pose.sighting.rays, np.ones(len(plane))]) * depth[:, None])
    return LocatedTarget(tuple(located), tuple(points), width, len(stationary))


def plane_pose(rays: Coordinates, plane: Coordinates) -> Float[np.ndarray, "4 4"]:
    """The rigid motion from a plane's axes to the camera that sees its points (x, y, 0), in their
    unit: from the homography (Zhang 2000, section 3.1), then by least squares in the image.
    ``rays`` are x / z and y / z in the camera."""
    columns = homography(plane, rays)
    columns = columns / np.linalg.norm(columns[:, :2], axis=0).mean() * np.sign(columns[2, 2])
    u, _, v = np.linalg.svd(np.column_stack([columns[:, :2], np.cross(*columns.T[:2])]))
    start = np.concatenate([rotvec_from_matrix(u @ v), columns[:, 2]])
    flat = np.column_stack([plane, np.zeros(len(plane))])

    def residuals(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, " k"]:
        points = flat @ matrix_from_rotvec(pose[:3]).T + pose[3:]
        return (points[:, :2] / points[:, 2:] - rays).ravel()

    pose = least_squares(residuals, start, x_scale="jac").x
    return rigid_transform(matrix_from_rotvec(pose[:3]), pose[3:]).numpy()


def _stationary_board(
    views: Sequence[Sequence[_BoardPose]], plane: Coordinates
) -> tuple[_Board | None, dict[int, _BoardPose]]:
    """The board at the place where most photos see it, and the poses of these photos, with their
    corners in one order; None if there are too few, or if they were taken from nearly the same
    place, which leaves the distance open."""
    couples = list(combinations(views, 2))
    most: dict[int, _BoardPose] = {}
    for index in evenly_spaced(len(couples), _MOST_HYPOTHESES):
        first, second = couples[index]
        guess = _from_two(first[0], second)
        consistent = {} if guess is None else _consistent(guess, views, plane, _ROUGH_SQUARES)
        if guess is not None and len(consistent) > len(most):
            best, most = guess, consistent
    if len(most) >= _FEWEST:
        board, uncertainty = _fitted(best, [pose.sighting for pose in most.values()], plane)
        consistent = _consistent(board, views, plane, _STATIONARY_SQUARES)
        if len(consistent) >= _FEWEST and uncertainty <= _UNCERTAIN:
            return board, consistent
    return None, {}


def _from_two(first: _BoardPose, second: Sequence[_BoardPose]) -> _Board | None:
    """The board that two photos see at one place; None if they do not. Their distances from it, in
    squares, follow from its perspective; the width of a square is that for which both agree."""
    own = first.in_world
    likeness = [float(np.trace(own[:, :3].T @ pose.in_world[:, :3])) for pose in second]
    if max(likeness) < 1 + 2 * np.cos(_TURNED_RAD):
        return None
    turned = second[int(np.argmax(likeness))]
    centre, other = (pose.sighting.camera.position.numpy() for pose in (first, turned))
    apart = turned.in_world[:, 3] - own[:, 3]
    square = float((centre - other) @ apart / max(apart @ apart, 1e-12))
    return _Board(own[:, :3], centre + square * own[:, 3], square) if square > 0 else None


def _consistent(
    board: _Board, views: Sequence[Sequence[_BoardPose]], plane: Coordinates, tolerance: float
) -> dict[int, _BoardPose]:
    """The views whose median reprojection error is below a share of a square, their corners in the
    board's order."""
    corners = board.corners(plane)
    found = {}
    for index, orderings in enumerate(views):
        first = orderings[0].sighting
        pixels = first.camera.project(corners)[0].numpy()  # NaN behind the camera
        errors_px = [
            np.median(np.linalg.norm(pixels - pose.sighting.photo.pixels, axis=1))
            for pose in orderings
        ]
        if min(errors_px) < tolerance * np.median(first.photo.spacing):
            found[index] = orderings[int(np.argmin(errors_px))]
    return found


def _fitted(
    board: _Board, sightings: Sequence[Sighting], plane: Coordinates
) -> tuple[_Board, float]:
    """The board with the least reprojection error, and its uncertainty: one standard deviation of
    the width of a square, as a share of it."""
    viewmats = np.stack([sighting.camera.viewmat.numpy() for sighting in sightings])
    seen = np.stack([sighting.rays for sighting in sightings])

    def moved(step: Float[np.ndarray, "7"]) -> _Board:
        return _Board(
            matrix_from_rotvec(step[:3]) @ board.rotation,
            board.origin + board.square * step[3:6],
            board.square * float(np.exp(step[6])),
        )

    def residuals(step: Float[np.ndarray, "7"]) -> Float[np.ndarray, " k"]:
        inside = np.einsum("vij,nj->vni", viewmats[:, :3, :3], moved(step).corners(plane))
        inside += viewmats[:, None, :3, 3]
        return (inside[..., :2] / inside[..., 2:] - seen).ravel()

    scale = float(np.median(np.abs(residuals(np.zeros(7))))) + 1e-9
    fit = least_squares(residuals, np.zeros(7), loss="soft_l1", f_scale=scale)
    covariance = np.mean(fit.fun**2) * np.linalg.pinv(np.einsum("ka,kb->ab", fit.jac, fit.jac))
    return moved(fit.x), float(np.sqrt(covariance[6, 6]))
