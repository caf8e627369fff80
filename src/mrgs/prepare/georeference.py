"""A reconstruction's scale and axes: from GPS, a known distance between two pixels of a photo, or
how the cameras were held."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from mrgs.data.earth import ecef, enu
from mrgs.data.radiometric import GpsPosition
from mrgs.errors import SceneError
from mrgs.prepare.contract import Georeference, Reconstruction
from mrgs.scene import PointCloud, WorldFrame
from mrgs.scene.lens import Lens
from mrgs.scene.similarity import Similarity, fit_robustly

ARBITRARY = "The scale is arbitrary."
KNOWN = "The scale is that of the known distance."

_UPRIGHT = math.cos(math.radians(10))
"""Given poses whose z axis is so near to up, as the cameras were held, are upright."""

MIN_POSITIONS = 4
"""Any three positions fit a similarity rather well; a fourth shows whether they are reliable."""

MAX_SCALE_ERROR = 0.05
MAX_TURN_DEG = 5.0
"""GPS is not used if it leaves a larger standard deviation (a conservative estimate)."""

LEAST_NOISE_M = 0.03
"""Least noise of EXIF positions, whatever the residuals: some phones repeat their last one."""

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

_MEAN_WEIGHT = 0.05


class UnusableGpsError(Exception):
    """Why the positions cannot be used for this reconstruction; half a sentence."""


def georeference(
    reconstruction: Reconstruction,
    gps: Mapping[str, GpsPosition],
    known: KnownDistance | float | None = None,
    *,
    as_given: bool = False,
) -> Georeference:
    """The similarity to a world with z up, in metres and with x east and y north where possible.
    SceneError if the known distance cannot be measured in the reconstruction.

    Args:
        reconstruction: poses in any world.
        gps: positions of photos by view; those of views without a pose are ignored.
        known: a length in a photo, or metres per unit; it overrides the scale from GPS.
        as_given: the poses come from the user. Their axes stay where their file says where on Earth
            they lie, where GPS agrees with them, and where there is no usable GPS.
    """
    scale = known if not isinstance(known, KnownDistance) else None
    if isinstance(known, KnownDistance):
        scale = known.metres / length_of(known, reconstruction)
    level = levelled(reconstruction)
    if as_given and level.rotation[2, 2] > _UPRIGHT:
        level = Similarity(1.0, np.eye(3), np.zeros(3))
    positions = {name: gps[name] for name in sorted(gps) if name in reconstruction.viewmats}
    given = reconstruction.world
    if as_given and (given.is_georeferenced or given.offset is not None):
        return _as_given(reconstruction.world, scale)
    warnings: tuple[str, ...] = ()
    if positions:
        try:
            return _by_gps(reconstruction, positions, level, scale, as_given=as_given)
        except UnusableGpsError as reason:
            warnings = (f"The GPS positions are not used: {reason}.",)
    if as_given:
        return _as_given(reconstruction.world, scale, warnings)
    return _without_gps(level, scale, warnings)


def apply(georeference: Georeference, reconstruction: Reconstruction) -> Reconstruction:
    """The reconstruction with poses and points in the new world."""
    rotation, translation = georeference.rotation, georeference.translation
    scale = georeference.scale
    viewmats = {}
    for name, viewmat in reconstruction.viewmats.items():
        moved = torch.eye(4, dtype=torch.float64)
        moved[:3, :3] = viewmat[:3, :3] @ rotation.T
        moved[:3, 3] = scale * viewmat[:3, 3] - moved[:3, :3] @ translation
        viewmats[name] = moved
    positions = scale * reconstruction.points.positions.double() @ rotation.T + translation
    points = PointCloud(positions.float(), reconstruction.points.colors)
    return replace(reconstruction, viewmats=viewmats, points=points)


def _without_gps(level: Similarity, scale: float | None, warnings: tuple[str, ...]) -> Georeference:
    factor = 1.0 if scale is None else scale
    return Georeference(
        scale=factor,
        rotation=torch.from_numpy(level.rotation),
        translation=torch.from_numpy(factor * level.translation),
        metric=scale is not None,
        north=False,
        origin=None,
        residual_m=None,
        text=f"{ARBITRARY if scale is None else KNOWN} North is not known; up is guessed from how "
        f"the cameras were held.",
        warnings=warnings,
    )


def _as_given(
    world: WorldFrame, scale: float | None, warnings: tuple[str, ...] = ()
) -> Georeference:
    """The frame of given poses, as far as it is known; only a known distance changes the scale."""
    origin = None if world.origin is None else GpsPosition(*world.origin)
    metres = "The scale is that of the given poses, in metres." if world.metric else ARBITRARY
    axes = "The axes are those of the given poses"
    return Georeference(
        scale=1.0 if scale is None else scale,
        rotation=torch.eye(3, dtype=torch.float64),
        translation=torch.zeros(3, dtype=torch.float64),
        metric=world.metric or scale is not None,
        north=world.north,
        origin=origin,
        residual_m=world.residual_m,
        text=f"{metres if scale is None else KNOWN} {axes}{', with north' * world.north}.",
        warnings=warnings,
        scale_error=world.scale_error if scale is None else None,
        offset=world.offset,
        control_m=world.control_m if scale is None else None,
    )


def _by_gps(
    reconstruction: Reconstruction,
    gps: Mapping[str, GpsPosition],
    level: Similarity,
    scale: float | None,
    *,
    as_given: bool,
) -> Georeference:
    """The similarity to metres east, north and up of the middle one of the positions. Without
    heights, or with cameras on a line, ``level`` gives the vertical, and the positions the rest.
    Given poses that are already in metres along these axes, as far as GPS can tell, only get a new
    origin. UnusableGpsError if there are too few positions, or if they are too noisy for how far
    the cameras are apart."""
    if len(gps) < MIN_POSITIONS:
        raise UnusableGpsError(
            f"{len(gps)} of the photos with a pose have one, and {MIN_POSITIONS} are needed"
        )
    with_height = {name: place for name, place in gps.items() if place.altitude_m is not None}
    used, warnings = with_height, tuple[str, ...]()
    reason = "the GPS positions have no heights"
    solution = None
    if len(with_height) >= max(MIN_POSITIONS, len(gps) / 2):
        solution = _solution(reconstruction, with_height, None, scale is None)
        reason = "the cameras stand on a line, about which GPS leaves the rotation open"
    if solution is None or solution.turn_deg > MAX_TURN_DEG:
        used = dict(gps)
        warnings = (f"The vertical is guessed from how the cameras were held: {reason}.",)
        solution = _solution(reconstruction, gps, level, scale is None)
        if solution.turn_deg > MAX_TURN_DEG:
            raise UnusableGpsError(_too_close(solution))
    found = _placed(solution, scale, warnings)
    if not as_given:
        return found
    similarity = solution.similarity
    turn_deg = math.degrees(np.linalg.norm(Rotation.from_matrix(similarity.rotation).as_rotvec()))
    agrees = (
        abs(math.log(similarity.scale)) <= AGREEMENT * solution.scale_error
        and turn_deg <= AGREEMENT * solution.turn_deg
    )
    if not agrees:
        return replace(found, text=f"{found.text} The given poses are turned and scaled to them.")
    places = torch.from_numpy(centres(reconstruction, used)[solution.inliers])
    middle, kept = places.mean(dim=0), 1.0 if scale is None else scale
    moved = found.scale * found.rotation @ middle + found.translation
    return replace(
        found,
        scale=kept,
        rotation=torch.eye(3, dtype=torch.float64),
        translation=moved - kept * middle,
        text=f"{found.text} The given poses have these already, and stay as they are.",
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    """A similarity by GPS, and what it leaves open: one standard deviation of the scale (a share of
    it) and of the rotation."""

    similarity: Similarity
    inliers: Bool[np.ndarray, " n"]
    origin: GpsPosition
    residual_m: float
    spread_m: float
    scale_error: float
    turn_deg: float


def _solution(
    reconstruction: Reconstruction,
    gps: Mapping[str, GpsPosition],
    level: Similarity | None,
    scale_matters: bool,
) -> _Solution:
    """The similarity that fits the cameras to their positions; errors follow from the cameras'
    spread about their mean and their line, noise is what nine of ten samples with these residuals
    stay below. ``level`` gives the vertical in place of heights; those of the cameras then count
    from their middle one. UnusableGpsError if the scale is left open."""
    positions = list(gps.values())
    earth = np.array([ecef(position) for position in positions])
    origin = positions[int(np.argmin([np.linalg.norm(earth - one, axis=1).sum() for one in earth]))]
    source, target = centres(reconstruction, gps), enu(positions, origin)
    if level is None:
        fit = fit_robustly(source, target)
        whole = fit.similarity
    else:
        upright = level(source)
        source, target = upright[:, :2], target[:, :2]
        fit = fit_robustly(source, target)
        flat, turn = fit.similarity, np.eye(3)
        turn[:2, :2] = flat.rotation
        shift = np.append(flat.translation, -flat.scale * np.median(upright[:, 2]))
        shift += flat.scale * np.einsum("ij,j->i", turn, level.translation)
        whole = Similarity(flat.scale * level.scale, turn @ level.rotation, shift)
    noise_m = max(
        fit.sigma * math.sqrt(fit.freedom / (2 * gammaincinv(fit.freedom / 2, 0.1))), LEAST_NOISE_M
    )
    moved = fit.similarity(source)
    placed = moved[fit.inliers]
    squares = np.linalg.svd(placed - placed.mean(axis=0), compute_uv=False) ** 2
    around = squares.sum() if level is not None else squares[1:].sum()
    solution = _Solution(
        whole,
        fit.inliers,
        origin,
        residual_m=float(np.median(np.linalg.norm(moved - target, axis=1))),
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


def _placed(solution: _Solution, scale: float | None, warnings: tuple[str, ...]) -> Georeference:
    """The solution, with the scale of a known distance if there is one."""
    inliers, similarity, residual_m = solution.inliers, solution.similarity, solution.residual_m
    if not inliers.all():
        warnings += (
            f"{(~inliers).sum()} of {len(inliers)} GPS positions disagree with the others and are "
            f"left out.",
        )
    ratio = 1.0 if scale is None else scale / similarity.scale
    if abs(math.log(ratio)) > DISAGREEMENT:
        warnings += (
            f"The known distance makes the scene {ratio:.2g} times as large as GPS does; check it.",
        )
    if residual_m > LARGEST_NOISE_M:
        warnings += (f"The cameras are {residual_m:.2g} m off GPS (median). {CONTRADICTION}.",)
    what = "metres and the axes east, north, up" if scale is None else "the axes east, north, up"
    text = (
        f"The GPS positions of {inliers.sum()} photos give {what}; the cameras are "
        f"{residual_m:.2g} m off them (median)."
    )
    return Georeference(
        scale=ratio * similarity.scale,
        rotation=torch.from_numpy(similarity.rotation),
        translation=torch.from_numpy(ratio * similarity.translation),
        metric=True,
        north=True,
        origin=solution.origin,
        residual_m=residual_m,
        text=text if scale is None else f"{KNOWN} {text}",
        warnings=warnings,
        scale_error=solution.scale_error if scale is None else None,
    )


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
    """The unit vector that is perpendicular to the rows of all photos and up in most: it minimises
    Σ (u · right_i)² + w Σ |u − up_i|². Of cameras that look straight down with changing headings,
    it is opposite to their viewing direction."""
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


NEIGHBOURS = 12
"""Triangulated points from which the depth of a pixel is interpolated."""

_MIN_NEIGHBOURS = 3
_SEARCH_SHARE = 0.05
_MAJORITY = 0.75
_MAX_SCATTER = 0.1
_REWEIGHTINGS = 10


@dataclass(frozen=True)
class KnownDistance:
    """A known distance between two points in a photo: the view's name, and x, y of both ends in
    pixels from the image's upper left corner."""

    view: str
    pixel_a: tuple[float, float]
    pixel_b: tuple[float, float]
    metres: float


def length_of(known: KnownDistance, reconstruction: Reconstruction) -> float:
    """The known distance in the reconstruction's units; each end is on its pixel's ray, on the
    surface through the triangulated points around. SceneError if the view has no pose, a pixel is
    outside of its image, points are lacking or at many depths, or the length is 0 or not finite."""
    if not (math.isfinite(known.metres) and known.metres > 0):
        raise SceneError(f"the known distance is {known.metres:g} m; it must be longer than 0 m")
    if known.view not in reconstruction.viewmats:
        some = ", ".join(sorted(reconstruction.viewmats)[:5])
        raise SceneError(
            f"the known distance is given in {known.view}, which has no pose; give it in another: "
            f"{some}, …"
        )
    points, pixels = _seen_points(known.view, reconstruction)
    lens = reconstruction.lenses[known.view]
    first, second = (
        _place(np.array(pixel, dtype=float), known.view, lens, points, pixels)
        for pixel in (known.pixel_a, known.pixel_b)
    )
    length = float(np.linalg.norm(second - first))
    if not length > 1e-9 * float(np.linalg.norm(first)):
        raise SceneError(
            f"the two ends of the known distance in {known.view} are one point; give two "
            f"different pixels"
        )
    return length


def _seen_points(
    view: str, reconstruction: Reconstruction
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"]]:
    """The points that a view sees, in the camera's axes, and their pixels."""
    world = reconstruction.points.positions.double().numpy()
    if reconstruction.visible is not None:
        world = world[reconstruction.visible[view].numpy()]
    viewmat, lens = reconstruction.viewmats[view].numpy(), reconstruction.lenses[view]
    points = np.einsum("ij,nj->ni", viewmat[:3, :3], world) + viewmat[:3, 3]
    points = points[points[:, 2] > 1e-9]
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    inside = lens.before_fold(x, y)
    u, v = lens.distort(x[inside], y[inside])
    return points[inside], np.column_stack([u * lens.fx + lens.cx, v * lens.fy + lens.cy])


def _place(
    pixel: Float64[np.ndarray, "2"],
    view: str,
    lens: Lens,
    points: Float64[np.ndarray, "n 3"],
    pixels: Float64[np.ndarray, "n 2"],
) -> Float64[np.ndarray, "3"]:
    """Where the ray of a pixel meets the surface, in the camera's axes."""
    where = f"pixel ({pixel[0]:g}, {pixel[1]:g}) of {view}"
    if not ((pixel >= 0) & (pixel <= [lens.width, lens.height])).all():
        raise SceneError(
            f"{where} is outside of the image of {lens.width}×{lens.height} px; give one inside"
        )
    distances = np.linalg.norm(pixels - pixel, axis=1)
    nearest = np.argsort(distances, kind="stable")[:NEIGHBOURS]
    nearest = nearest[distances[nearest] <= _SEARCH_SHARE * max(lens.width, lens.height)]
    if len(nearest) < _MIN_NEIGHBOURS:
        raise SceneError(
            f"{where} has no reconstructed points near it; choose one on a surface with more detail"
        )
    inverse_depth, scatter = _surface(pixels[nearest] - pixel, 1 / points[nearest, 2])
    if not (inverse_depth > 0 and scatter <= _MAX_SCATTER):
        raise SceneError(
            f"{where} lies where near and far surfaces meet; choose one that is well inside a "
            f"surface"
        )
    return np.array([*lens.rays(*pixel), 1.0]) / inverse_depth


def _surface(
    offsets: Float64[np.ndarray, "n 2"], inverse_depths: Float64[np.ndarray, " n"]
) -> tuple[float, float]:
    """1/depth at offset 0, and the relative deviation that most points do not exceed, by reweighted
    least absolute deviations: linear in the pixel, as of a plane; constant with few points."""
    columns = offsets if len(offsets) >= NEIGHBOURS // 2 else offsets[:, :0]
    design = np.column_stack([np.ones(len(offsets)), columns / max(np.abs(offsets).max(), 1e-9)])
    weights = np.ones(len(offsets))
    for _ in range(_REWEIGHTINGS):
        root = np.sqrt(weights)
        solution = np.linalg.lstsq(design * root[:, None], inverse_depths * root, rcond=None)[0]
        deviations = np.abs(inverse_depths - (design * solution).sum(axis=1))
        weights = 1 / np.maximum(deviations, 1e-3 * np.abs(inverse_depths).mean())
    return float(solution[0]), float(np.quantile(deviations, _MAJORITY) / abs(solution[0]))
