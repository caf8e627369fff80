"""Comparison of images at the points that they see: automatic gain or exposure makes them
differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mrgs.check.problem import Problem, views_text
from mrgs.data.undistort import sampled
from mrgs.scene import THERMAL, Camera, Modality, PointCloud
from mrgs.scene.view import evenly_spaced

FEWEST_VIEWS = 3
"""Fewest images that must see a point to determine its usual value."""

_FEWEST_POINTS = 30
_MOST_POINTS = 3000
_ROUNDS = 3
_JUMP = 0.03
"""Smallest error of an image that jumps, as a share of the set's range."""

_EXPLAINED = 0.6
"""Largest share of that error which remains after gain and offset have been removed."""


@dataclass(frozen=True)
class Agreement:
    """How an image's values relate to the usual values at the same points: value ≈ gain · usual +
    offset. The usual value of a point is the median over the images that see it.

    Attributes:
        gain: of the image, relative to most.
        offset: at the middle of the set's values, as a share of the set's range.
        error: median distance from the usual value, as a share of the set's range.
        corrected: the error after gain and offset have been removed.
    """

    gain: float
    offset: float
    error: float
    corrected: float

    @property
    def jumps(self) -> bool:
        """Whether the image was taken with another gain or offset than most."""
        return self.error > _JUMP and self.corrected < _EXPLAINED * self.error


def agreements(
    images: Sequence[Float[np.ndarray, "..."] | None],
    cameras: Sequence[Camera | None],
    points: PointCloud,
) -> list[Agreement | None]:
    """The agreement of each image with the others; None where it shares too few points with them.

    Occlusions are not detected: medians over views and points are robust to them.

    Args:
        images: [H, W] each, in one unit; NaN where not valid; None for a view without one.
        points: in world coordinates.
    """
    values = _values_at_points(images, cameras, points)
    usual = _usual(values)
    known = np.isfinite(usual)
    if known.sum() < _FEWEST_POINTS:
        return [None] * len(images)
    low, high = np.quantile(usual[known], [0.02, 0.98])
    span = max(float(high - low), 1e-9)
    return [_agreement((row - low) / span, (usual - low) / span) for row in values]


def _values_at_points(
    images: Sequence[Float[np.ndarray, "..."] | None],
    cameras: Sequence[Camera | None],
    points: PointCloud,
) -> Float[np.ndarray, "v n"]:
    """The value of each image at each point; NaN where the image does not see it."""
    positions = points.positions[evenly_spaced(len(points.positions), _MOST_POINTS)].double()
    values = np.full((len(images), len(positions)), np.nan)
    for row, image, camera in zip(values, images, cameras, strict=True):
        if image is not None and camera is not None:
            pixels, _ = camera.project(positions)
            seen = camera.contains(pixels).numpy()
            x, y = pixels.numpy()[seen].T
            row[seen] = sampled(image.astype(np.float64), x, y)
    return values


def _usual(values: Float[np.ndarray, "v n"]) -> Float[np.ndarray, " n"]:
    """The median over the images that see a point; NaN where they are too few."""
    usual = np.full(values.shape[1], np.nan)
    enough = np.isfinite(values).sum(axis=0) >= FEWEST_VIEWS
    usual[enough] = np.nanmedian(values[:, enough], axis=0)
    return usual


def _agreement(own: Float[np.ndarray, " n"], usual: Float[np.ndarray, " n"]) -> Agreement | None:
    both = np.isfinite(own) & np.isfinite(usual)
    if both.sum() < _FEWEST_POINTS:
        return None
    x, y = usual[both] - 0.5, own[both] - 0.5
    gain, offset = 1.0, float(np.median(y - x))
    weights = np.ones_like(x)
    for _ in range(_ROUNDS):  # least squares, with less weight where something hides the point
        gain, offset = _line(x, y, weights)
        distance = np.abs(y - gain * x - offset)
        weights = 1 / np.maximum(distance, 0.02)
    error = float(np.median(np.abs(y - x)))
    return Agreement(gain, offset, error, float(np.median(np.abs(y - gain * x - offset))))


def _line(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"]
) -> tuple[float, float]:
    """Gain and offset of the weighted least-squares line; gain 1 where all x are equal."""
    weights = weights / weights.sum()
    mean_x, mean_y = (weights * x).sum(), (weights * y).sum()
    variance = (weights * (x - mean_x) ** 2).sum()
    gain = (weights * (x - mean_x) * (y - mean_y)).sum() / variance if variance > 1e-12 else 1.0
    return float(gain), float(mean_y - gain * mean_x)


def jump(modality: Modality, names: Sequence[str], radiometric: bool) -> Problem:
    """The warning about images that do not agree with the others.

    Args:
        radiometric: whether the temperatures are computed from the thermal camera's signal.
    """
    changed, cause = "warmer or colder", "as automatic gain or a changed span makes them"
    remedy = "Export all thermal images with one fixed span, or from radiometric files."
    if modality != THERMAL:
        changed, cause = "brighter or darker", "as automatic exposure makes them"
        remedy = "The colours will be a mixture; fix exposure and white balance next time."
    elif radiometric:
        cause = (
            "though the photos are radiometric: the surfaces have warmed or cooled, the camera has "
            "drifted, or its settings were changed"
        )
        remedy = "Compare these photos and their settings with the others, and leave out outliers."
    text = f"In {views_text(names)} the same places are {changed} than in the others, {cause}."
    return Problem("warning", text, remedy)
