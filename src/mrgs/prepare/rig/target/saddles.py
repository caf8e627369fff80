"""Saddle points of an image: where four squares of a chessboard meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, maximum_filter

from mrgs.data.undistort import sampled

_LEAST_CONTRAST = 0.04
"""σ⁴(Hxy² − Hxx Hyy) over the variance around: about 0.4 where four sharp squares meet, whatever
their contrast."""

_SURROUNDINGS = 2.0
_FARTHEST = 1.5
_NARROWEST_RAD = np.radians(25)
_MOST = 4000
_FIT_SAMPLES = 21
_FIT_STEPS = 6


@dataclass(frozen=True, eq=False)
class Saddles:
    """N saddle points, the clearest first.

    Attributes:
        pixels: positions x, y.
        angles: of the four edges that leave each, radians, in turn from x to y (clockwise in the
            image): the first two and their opposites.
        bright: whether the quarter between the first two edges is the brighter one.
    """

    pixels: Float[np.ndarray, "n 2"]
    angles: Float[np.ndarray, "n 4"]
    bright: Bool[np.ndarray, " n"]


def find_saddles(image: Float[np.ndarray, "h w"], sigma_px: float) -> Saddles:
    """The saddle points of an image after a Gaussian blur.

    The determinant of the Hessian is most negative at them (Chen and Zhang, 2005); in its
    asymptotic directions the image neither rises nor falls: they are the edges between the squares,
    also in perspective.
    """
    xx, xy, yy = (
        gaussian_filter(image, sigma_px, order=order) for order in ((0, 2), (1, 1), (2, 0))
    )
    strength = (xy**2 - xx * yy) * sigma_px**4
    smooth = gaussian_filter(image, _SURROUNDINGS * sigma_px)
    variance = gaussian_filter((image - smooth) ** 2, _SURROUNDINGS * sigma_px)
    contrast = strength / (variance + 1e-9 * image.var() + 1e-30)
    peak = strength == maximum_filter(strength, size=2 * round(sigma_px) + 1)
    row, column = np.nonzero(peak & (contrast > _LEAST_CONTRAST))
    best = np.argsort(-contrast[row, column], kind="stable")[:_MOST]
    row, column = row[best], column[best]
    hessian = np.stack([xx[row, column], xy[row, column], yy[row, column]], axis=1)
    slope = np.stack(
        [gaussian_filter(image, sigma_px, order=order)[row, column] for order in ((0, 1), (1, 0))],
        axis=1,
    )
    offset = _stationary(hessian, slope)
    angles, bright = _edges(hessian)
    width = angles[:, 1] - angles[:, 0]
    kept = (
        (np.abs(offset).max(axis=1) < _FARTHEST)
        & (width > _NARROWEST_RAD)
        & (width < np.pi - _NARROWEST_RAD)
    )
    pixels = np.column_stack([column, row]) + 0.5 + offset
    return Saddles(pixels[kept], angles[kept], bright[kept])


def refined(
    image: Float[np.ndarray, "h w"],
    pixels: Float[np.ndarray, "n 2"],
    radius_px: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 2"]:
    """Saddle points to a fraction of a pixel; NaN where there is none.

    A second-degree polynomial is fitted to the values around, with Gaussian weights; its stationary
    point is the next centre (Lucchese and Mitra, 2002).

    Args:
        image: any unit.
        radius_px: of the fit, for each; less than half a square.
    """
    grid = np.linspace(-1, 1, _FIT_SAMPLES)
    x, y = (values.ravel() for values in np.meshgrid(grid, grid))
    weight = np.exp(-2 * (x**2 + y**2)) * (x**2 + y**2 <= 1)
    terms = np.column_stack([x * x / 2, x * y, y * y / 2, x, y, np.ones_like(x)])
    solve = np.linalg.pinv(terms * weight[:, None]) * weight
    found = pixels.copy()
    for _ in range(_FIT_STEPS):
        u = found[:, 0, None] + radius_px[:, None] * x
        v = found[:, 1, None] + radius_px[:, None] * y
        values = sampled(image, u, v)
        fit = np.einsum("ks,ns->nk", solve, values)
        is_saddle = fit[:, 1] ** 2 > fit[:, 0] * fit[:, 2]
        step = _stationary(fit[:, :3], fit[:, 3:5]) * radius_px[:, None]
        found += np.clip(
            np.where(is_saddle[:, None], step, np.nan), -radius_px[:, None], radius_px[:, None]
        )
        found[np.abs(found - pixels).max(axis=1) > radius_px] = np.nan
    return found


def _stationary(
    hessian: Float[np.ndarray, "n 3"], slope: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Where a polynomial with second derivatives xx, xy, yy and this slope at 0 is stationary."""
    xx, xy, yy = hessian.T
    determinant = xx * yy - xy**2
    with np.errstate(all="ignore"):
        x = (xy * slope[:, 1] - yy * slope[:, 0]) / determinant
        y = (xy * slope[:, 0] - xx * slope[:, 1]) / determinant
    return np.column_stack([x, y])


def _edges(
    hessian: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 4"], Bool[np.ndarray, " n"]]:
    """The asymptotic directions, and whether the image is brighter between the first two of them.

    Along the direction φ the second derivative is mean + half · cos 2(φ − main): it vanishes at two
    angles from main.
    """
    xx, xy, yy = hessian.T
    mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    main = np.arctan2(2 * xy, xx - yy) / 2
    opening = np.arccos(np.clip(-mean / np.maximum(half, 1e-30), -1, 1)) / 2
    pair = np.sort(np.stack([main - opening, main + opening], axis=1) % np.pi, axis=1)
    middle = pair.mean(axis=1)
    bright = mean + half * np.cos(2 * (middle - main)) > 0
    return np.concatenate([pair, pair + np.pi], axis=1), bright
