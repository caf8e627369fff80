"""Scale and north from the GPS positions of the photos."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from mrgs.data.earth import ecef, enu
from mrgs.data.radiometric import GpsPosition
from mrgs.prepare.contract import Georeference, Reconstruction
from mrgs.prepare.similarity import RobustFit, Similarity, fit_robustly

MIN_POSITIONS = 4
"""Any three positions fit a similarity rather well; a fourth shows whether they are reliable."""

MAX_SCALE_ERROR = 0.05
MAX_TURN_DEG = 5.0
"""GPS is not used if it leaves a larger uncertainty (one standard deviation, a conservative
estimate)."""

LEAST_NOISE_M = 0.03
"""Least noise of positions in EXIF, even where their residuals are smaller: some phones repeat
their last one."""

LARGEST_NOISE_M = 5.0
"""Positions that are off by more (median) contradict the poses."""

CONTRADICTION = (
    "GPS rarely errs by so much: parts of the scene that look alike may lie on each other in it; "
    "look at the cameras' path on the page"
)

DISAGREEMENT = 0.1
"""Log ratio of the scale by GPS and that by a known distance above which the user is warned."""


AGREEMENT = 3.0
"""Given poses whose scale and axes differ by fewer standard deviations from those by GPS stay: they
are surer than it."""


class UnusableGpsError(Exception):
    """Why the positions cannot be used for this reconstruction; half a sentence."""


def place_by_gps(
    reconstruction: Reconstruction,
    gps: Mapping[str, GpsPosition],
    level: Similarity,
    scale: float | None,
    *,
    as_given: bool = False,
) -> Georeference:
    """The similarity to metres east, north and up of the middle one of the positions.

    Without heights, and where the cameras stand on a line about which the positions leave the
    rotation open, ``level`` gives the vertical, and the positions the rest.

    Args:
        reconstruction: poses in any world.
        gps: positions by view, all with a pose.
        scale: metres per unit, where it is known; then the positions only turn and move.
        as_given: where the poses are in metres and have these axes, as far as GPS knows, only their
            origin moves.

    Raises:
        UnusableGpsError: too few positions, or too much noise for how far the cameras are apart.
    """
    if len(gps) < MIN_POSITIONS:
        raise UnusableGpsError(
            f"{len(gps)} of the photos with a pose have one, and {MIN_POSITIONS} are needed"
        )
    with_height = {name: place for name, place in gps.items() if place.altitude_m is not None}
    reason = "the GPS positions have no heights"
    if len(with_height) >= max(MIN_POSITIONS, len(gps) / 2):
        solution = _in_space(reconstruction, with_height, scale is None)
        if solution.turn_deg <= MAX_TURN_DEG:
            return _placed(solution, scale, (), reconstruction, with_height, as_given)
        reason = "the cameras stand on a line, about which GPS leaves the rotation open"
    solution = _on_the_plane(reconstruction, gps, level, scale is None)
    if solution.turn_deg > MAX_TURN_DEG:
        raise UnusableGpsError(_too_close(solution))
    guessed = (f"The vertical is guessed from how the cameras were held: {reason}.",)
    return _placed(solution, scale, guessed, reconstruction, gps, as_given)


@dataclass(frozen=True, eq=False)
class _Solution:
    """A fit, and what it leaves open: one standard deviation of the scale (a share of it) and of
    the rotation."""

    similarity: Similarity
    fit: RobustFit
    origin: GpsPosition
    residuals_m: Float64[np.ndarray, " n"]
    spread_m: float
    scale_error: float
    turn_deg: float

    @property
    def residual_m(self) -> float:
        """The median of the residuals."""
        return float(np.median(self.residuals_m))


def _in_space(
    reconstruction: Reconstruction, gps: Mapping[str, GpsPosition], scale_matters: bool
) -> _Solution:
    source, origin = centres(reconstruction, gps), _middle(list(gps.values()))
    target = enu(list(gps.values()), origin)
    fit = fit_robustly(source, target)
    return _solution(fit, fit.similarity, source, target, origin, scale_matters)


def _on_the_plane(
    reconstruction: Reconstruction,
    gps: Mapping[str, GpsPosition],
    level: Similarity,
    scale_matters: bool,
) -> _Solution:
    """The heights of the positions are not used; the cameras' own are counted from their middle
    one."""
    upright, origin = level(centres(reconstruction, gps)), _middle(list(gps.values()))
    target = enu(list(gps.values()), origin)[:, :2]
    fit = fit_robustly(upright[:, :2], target)
    turn, flat = np.eye(3), fit.similarity
    turn[:2, :2] = flat.rotation
    translation = np.append(flat.translation, -flat.scale * np.median(upright[:, 2]))
    rotation = turn @ level.rotation
    translation = translation + flat.scale * np.einsum("ij,j->i", turn, level.translation)
    whole = Similarity(flat.scale * level.scale, rotation, translation)
    return _solution(fit, whole, upright[:, :2], target, origin, scale_matters)


def _solution(
    fit: RobustFit,
    whole: Similarity,
    source: Float64[np.ndarray, "n d"],
    target: Float64[np.ndarray, "n d"],
    origin: GpsPosition,
    scale_matters: bool,
) -> _Solution:
    """The errors of a least-squares similarity follow from the cameras' spread about their mean and
    about their line.

    The noise is that which nine of ten samples with these residuals do not exceed.

    Raises:
        UnusableGpsError: the scale is left open.
    """
    noise_m = max(
        fit.sigma * math.sqrt(fit.freedom / (2 * gammaincinv(fit.freedom / 2, 0.1))), LEAST_NOISE_M
    )
    moved = fit.similarity(source)
    placed = moved[fit.inliers]
    squares = np.linalg.svd(placed - placed.mean(axis=0), compute_uv=False) ** 2
    around = squares.sum() if source.shape[1] == 2 else squares[1:].sum()
    solution = _Solution(
        whole,
        fit,
        origin,
        np.linalg.norm(moved - target, axis=1),
        spread_m=math.sqrt(squares.sum() / len(placed)),
        scale_error=noise_m / math.sqrt(max(squares.sum(), 1e-12)),
        turn_deg=math.degrees(noise_m / math.sqrt(max(around, 1e-12))),
    )
    if scale_matters and solution.scale_error > MAX_SCALE_ERROR:
        raise UnusableGpsError(_too_close(solution))
    return solution


def _too_close(solution: _Solution) -> str:
    off = f"they are {solution.residual_m:.2g} m (median) off the cameras"
    if solution.residual_m > LARGEST_NOISE_M:
        return f"{off}. {CONTRADICTION}"
    return (
        f"{off}, which are too close together for "
        f"that ({solution.spread_m:.2g} m about their middle)"
    )


def _georeference(
    solution: _Solution, scale: float | None, warnings: tuple[str, ...]
) -> Georeference:
    inliers, similarity = solution.fit.inliers, solution.similarity
    if not inliers.all():
        outliers = int((~inliers).sum())
        warnings += (
            f"{outliers} of {len(inliers)} GPS positions disagree with the others and are left "
            f"out.",
        )
    ratio = 1.0 if scale is None else scale / similarity.scale
    if abs(math.log(ratio)) > DISAGREEMENT:
        warnings += (
            f"The known distance makes the scene {ratio:.2g} times as large as GPS does; check it.",
        )
    residual_m = solution.residual_m
    if residual_m > LARGEST_NOISE_M:
        warnings += (f"The cameras are {residual_m:.2g} m off GPS (median). {CONTRADICTION}.",)
    what = "metres and the axes east, north, up" if scale is None else "the axes east, north, up"
    used = int(inliers.sum())
    text = (
        f"The GPS positions of {used} photos give {what}; the cameras are {residual_m:.2g} m "
        f"off them (median)."
    )
    return Georeference(
        scale=ratio * similarity.scale,
        rotation=torch.from_numpy(similarity.rotation),
        translation=torch.from_numpy(ratio * similarity.translation),
        metric=True,
        north=True,
        origin=solution.origin,
        residual_m=residual_m,
        text=text if scale is None else f"The scale is that of the known distance. {text}",
        warnings=warnings,
        scale_error=solution.scale_error if scale is None else None,
    )


def _placed(
    solution: _Solution,
    scale: float | None,
    warnings: tuple[str, ...],
    reconstruction: Reconstruction,
    gps: Mapping[str, GpsPosition],
    as_given: bool,
) -> Georeference:
    """The solution as it is; of given poses that it agrees with, only the origin moves."""
    found = _georeference(solution, scale, warnings)
    if not as_given:
        return found
    if not _agrees(solution):
        return replace(found, text=f"{found.text} The given poses are turned and scaled to them.")
    places = torch.from_numpy(centres(reconstruction, gps)[solution.fit.inliers])
    middle, kept = places.mean(dim=0), 1.0 if scale is None else scale
    moved = found.scale * found.rotation @ middle + found.translation
    return replace(
        found,
        scale=kept,
        rotation=torch.eye(3, dtype=torch.float64),
        translation=moved - kept * middle,
        text=f"{found.text} The given poses have these already, and stay as they are.",
    )


def _agrees(solution: _Solution) -> bool:
    """Whether the poses had this scale and these axes before, as far as GPS knows."""
    similarity = solution.similarity
    turn_deg = math.degrees(np.linalg.norm(Rotation.from_matrix(similarity.rotation).as_rotvec()))
    return (
        abs(math.log(similarity.scale)) <= AGREEMENT * solution.scale_error
        and turn_deg <= AGREEMENT * solution.turn_deg
    )


def _middle(positions: Sequence[GpsPosition]) -> GpsPosition:
    """The position with the least sum of distances to the others."""
    places = np.array([ecef(position) for position in positions])
    sums = [np.linalg.norm(places - place, axis=1).sum() for place in places]
    return positions[int(np.argmin(sums))]


_MEAN_WEIGHT = 0.05


def centres(reconstruction: Reconstruction, names: Iterable[str]) -> Float64[np.ndarray, "n 3"]:
    """Camera centres of views [N, 3], in the world of the reconstruction."""
    viewmats = np.stack([reconstruction.viewmats[name].numpy() for name in names])
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def levelled(reconstruction: Reconstruction) -> Similarity:
    """The similarity to a world with z up, y along the mean viewing direction, and the origin at
    the median of the points; the scale is kept."""
    up = up_of_cameras(reconstruction)
    forward = _axes(reconstruction)[:, 2].mean(axis=0)
    ahead = forward - (forward * up).sum() * up
    if np.linalg.norm(ahead) < 1e-3:  # all look straight down, or around in a circle
        ahead = np.eye(3)[np.abs(up).argmin()]
        ahead = ahead - (ahead * up).sum() * up
    ahead = ahead / np.linalg.norm(ahead)
    rotation = np.stack([np.cross(ahead, up), ahead, up])
    points = reconstruction.points.positions.double().numpy()
    amid = points if len(points) else centres(reconstruction, reconstruction.viewmats)
    return Similarity(1.0, rotation, -np.einsum("ij,j->i", rotation, np.median(amid, axis=0)))


def up_of_cameras(reconstruction: Reconstruction) -> Float64[np.ndarray, "3"]:
    """The unit vector that is perpendicular to the rows of all photos and up in most of them.

    It minimises Σ (u · right_i)² + w Σ |u − up_i|². Cameras that look straight down with changing
    headings have no common up: it is then opposite to their viewing direction.
    """
    axes = _axes(reconstruction)
    right, up, forward = axes[:, 0], -axes[:, 1].mean(axis=0), axes[:, 2].mean(axis=0)
    if np.linalg.norm(forward) > 0.9 and np.linalg.norm(up) < 0.5:
        up = -forward
    normal = np.einsum("ni,nj->ij", right, right) / len(right) + _MEAN_WEIGHT * np.eye(3)
    solution = np.linalg.solve(normal, up)
    length = np.linalg.norm(solution)
    return solution / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def _axes(reconstruction: Reconstruction) -> Float64[np.ndarray, "n 3 3"]:
    """The cameras' axes (right, down, forward) as rows, in world coordinates."""
    return torch.stack(list(reconstruction.viewmats.values()))[:, :3, :3].numpy()
