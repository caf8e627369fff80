"""A known length between two pixels of a photo, in the units of the reconstruction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from mrgs.errors import SceneError
from mrgs.prepare.contract import Reconstruction
from mrgs.scene.lens import Lens

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
    x, y = lens.undistort(
        np.array([(pixel[0] - lens.cx) / lens.fx]), np.array([(pixel[1] - lens.cy) / lens.fy])
    )
    return np.array([x[0], y[0], 1.0]) / inverse_depth


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
