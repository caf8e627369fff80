"""A chessboard in a photo or in a thermal image: the inner corners, where four squares meet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter, maximum_filter, zoom
from scipy.spatial import cKDTree

from mrgs.data.undistort import sampled

Points: TypeAlias = Float[np.ndarray, "n 2"]

_LARGEST_PX, _SMALLEST_PX = 1280, 100
_SIGMAS_PX = (1.5, 2.5)
_LEAST_FILLED = 0.6
_FIT_SQUARES = 0.3
_QUARTER_SQUARES = 0.35
_IRREGULAR_SQUARES = 0.15
_RING = 24
_LEAST_RING, _AROUND_PX = 1.2, 40
"""Contrast around the middle of a target, in standard deviations of so many pixels around."""


@dataclass(frozen=True, eq=False)
class Corners:
    """The inner corners of a chessboard in an image: positions x, y in pixels. The direction along
    a row turns clockwise into that along a column: the board is seen from its front. The image does
    not show which of the board's corners is the first: see ``orderings``."""

    grid: Float[np.ndarray, "rows columns 2"]

    @property
    def pixels(self) -> Points:
        """Positions x, y in pixels, row by row."""
        return self.grid.reshape(-1, 2)

    @property
    def spacing(self) -> Float[np.ndarray, "rows columns"]:
        """Distance of each corner from its nearest neighbour, in pixels."""
        along, down = (np.linalg.norm(np.diff(self.grid, axis=axis), axis=2) for axis in (1, 0))
        along = np.pad(along, ((0, 0), (1, 1)), constant_values=np.inf)
        down = np.pad(down, ((1, 1), (0, 0)), constant_values=np.inf)
        return np.minimum.reduce([along[:, :-1], along[:, 1:], down[:-1], down[1:]])

    def orderings(self) -> list[Corners]:
        """The corners in each order that looks the same: two, or four if the board is square."""
        rows, columns, _ = self.grid.shape
        turns = range(0, 4, 1 if rows == columns else 2)
        return [Corners(np.rot90(self.grid, quarters)) for quarters in turns]


def detect_chessboard(image: Float[np.ndarray, "h w"], inner: tuple[int, int]) -> Corners | None:
    """Find a chessboard of which all inner corners are in the image; None if there is none. Saddle
    points of several scales are linked to a grid along their edges, and placed to a fraction of a
    pixel; the four squares around each must alternate, in either order. The image may have any unit
    and lens distortion; ``inner`` is how many corners are in a row and a column, at least 3."""
    image = (image - np.median(image)).astype(np.float32)
    for saddles in _at_scales(image):
        for lattice in _lattices(saddles):
            for part in _board_parts(lattice, inner):
                corners = _completed(image, saddles, part, inner)
                if _is_board(image, corners) and not _is_part_of_larger(image, corners):
                    return corners
    return None


def saddle_near(
    image: Float[np.ndarray, "h w"], pixel: Float[np.ndarray, "2"], reach_px: float
) -> Float[np.ndarray, "2"] | None:
    """The place within reach of a pixel x, y where two bright and two dark quarters meet, to a
    fraction of a pixel, the nearest of several; None if none stands out from what is around."""
    margin = reach_px + _AROUND_PX
    corner = np.maximum(np.floor(pixel - margin), 0).astype(int)
    (left, top), (right, bottom) = corner, np.ceil(pixel + margin).astype(int)
    part = image[top:bottom, left:right].astype(np.float32)
    known = np.isfinite(part)
    if not known.any():
        return None
    part = np.where(known, part, np.median(part[known])) - np.median(part[known])
    found = []
    for sigma_px in _SIGMAS_PX:
        saddles = _find_saddles(part, sigma_px).pixels
        near = saddles[np.linalg.norm(saddles + corner - pixel, axis=1) <= reach_px]
        places = _refined(part, near, np.full(len(near), 2 * sigma_px))
        places = places[np.isfinite(places).all(axis=1)]
        found += [(_contrast(part, place, sigma_px), place + corner) for place in places]
    clearest = max((contrast for contrast, _ in found), default=0.0)
    if clearest < _LEAST_RING * part.std():
        return None
    chosen = [place for contrast, place in found if contrast > 0.7 * clearest]
    nearest: Float[np.ndarray, "2"] = min(chosen, key=lambda place: np.linalg.norm(place - pixel))
    return nearest


def _contrast(
    image: Float[np.ndarray, "h w"], middle: Float[np.ndarray, "2"], sigma_px: float
) -> float:
    """By how much an image is bright twice and dark twice around a place, on two rings alike; 0
    where half of the variance on either is of another frequency."""
    angle = np.arange(_RING) * (2 * np.pi / _RING)
    waves = []
    for radius_px in (1.5 * sigma_px, 3 * sigma_px):
        x, y = middle[0] + radius_px * np.cos(angle), middle[1] + radius_px * np.sin(angle)
        wave = np.fft.rfft(sampled(image, x, y))[1:] * (2 / _RING)
        if not np.abs(wave[1]) ** 2 > 0.5 * (np.abs(wave) ** 2).sum():
            return 0.0
        waves.append(wave[1])
    return float(min(map(abs, waves)) * max(np.cos(np.angle(waves[0] / waves[1])), 0.0))


def board_points(columns: int, rows: int) -> Points:
    """The inner corners on a board whose squares are 1 wide: x, y, row by row."""
    return np.indices((rows, columns))[::-1].reshape(2, -1).T.astype(np.float64)


def homography(source: Points, target: Points) -> Float[np.ndarray, "3 3"]:
    """The projective map of four or more points onto others, by the normalised direct linear
    transformation (Hartley and Zisserman, algorithm 4.2)."""
    normal_a, normal_b = _normalisation(source), _normalisation(target)
    a, b = transformed(normal_a, source), transformed(normal_b, target)
    factors = np.dstack([np.tile(np.eye(2), (len(b), 1, 1)), -b])
    lifted = np.column_stack([a, np.ones(len(a))])
    equations = np.einsum("nij,nk->nijk", factors, lifted).reshape(-1, 9)
    matrix = np.linalg.svd(equations)[2][-1].reshape(3, 3)
    return np.linalg.inv(normal_b) @ matrix @ normal_a


def _normalisation(points: Points) -> Float[np.ndarray, "3 3"]:
    """The map that centres points and makes their mean distance from the centre √2."""
    x, y = points.mean(axis=0)
    scale = np.sqrt(2) / np.hypot(points[:, 0] - x, points[:, 1] - y).mean()
    return np.array([[scale, 0, -scale * x], [0, scale, -scale * y], [0, 0, 1]])


def transformed(matrix: Float[np.ndarray, "3 3"], points: Points) -> Points:
    """Points under a projective map."""
    lifted = np.einsum("ij,nj->ni", matrix[:, :2], points) + matrix[:, 2]
    return lifted[:, :2] / lifted[:, 2:]


class _Lattice(NamedTuple):
    """Saddle points (by index) and their cells (column, row), numbered from anywhere."""

    cells: Int[np.ndarray, "n 2"]
    points: Int[np.ndarray, " n"]


def _board_parts(lattice: _Lattice, inner: tuple[int, int]) -> list[_Lattice]:
    """Parts of a lattice with the size of the board, those with the most saddle points first;
    columns along the board's rows, cells numbered from the part's first."""
    cells, points = lattice
    least = _LEAST_FILLED * inner[0] * inner[1]
    if len(points) < least:
        return []
    upright = [cells]
    if inner[0] != inner[1]:
        upright.append(np.column_stack([cells[:, 1], -cells[:, 0]]))
    parts = []
    for own in upright:
        low, high = own.min(axis=0) - 1, own.max(axis=0) - inner + 3
        for first in np.ndindex(*np.maximum(high - low, 0)):
            shifted = own - low - first
            inside = ((shifted >= 0) & (shifted < inner)).all(axis=1)
            if inside.sum() >= least:
                parts.append(_Lattice(shifted[inside], points[inside]))
    return sorted(parts, key=lambda part: -len(part.points))


def _completed(
    image: Float[np.ndarray, "h w"], saddles: _Saddles, part: _Lattice, inner: tuple[int, int]
) -> Corners:
    """All corners of a board: saddle points of the part, and the others by its homography, refined
    in the image; NaN where there is no saddle."""
    columns, rows = inner
    found = saddles.pixels[part.points]
    pixels = transformed(homography(part.cells.astype(float), found), board_points(*inner))
    pixels[part.cells @ (1, columns)] = found
    radius_px = _FIT_SQUARES * Corners(pixels.reshape(rows, columns, 2)).spacing.ravel()
    return Corners(_refined(image, pixels, radius_px).reshape(rows, columns, 2))


def _is_board(image: Float[np.ndarray, "h w"], corners: Corners) -> bool:
    """Whether each corner is nearly in the middle between its neighbours, and the two squares of
    one diagonal are brighter than both of the other, by turns."""
    grid, spacing = corners.grid, corners.spacing
    bends = [np.linalg.norm(np.diff(grid, n=2, axis=axis), axis=2) / 2 for axis in (0, 1)]
    limit = _IRREGULAR_SQUARES * spacing
    if not ((bends[0] < limit[1:-1]).all() and (bends[1] < limit[:, 1:-1]).all()):
        return False  # also where a corner is NaN
    along, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    smooth = gaussian_filter(image, _QUARTER_SQUARES / 3 * float(spacing.min()))
    a, b, c, d = (
        sampled(smooth, *np.moveaxis(grid + _QUARTER_SQUARES * (i * along + j * down), -1, 0))
        for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    )
    brighter = np.minimum(a, c) > np.maximum(b, d)
    darker = np.maximum(a, c) < np.minimum(b, d)
    even = np.indices(brighter.shape).sum(axis=0) % 2 == 0
    return bool(np.where(even, brighter, darker).all() or np.where(even, darker, brighter).all())


def _is_part_of_larger(image: Float[np.ndarray, "h w"], corners: Corners) -> bool:
    """Whether there is one more row or column: any other part of that board would fit as well."""
    for quarters in range(4):
        grid = np.rot90(corners.grid, quarters)
        radius_px = _FIT_SQUARES * np.linalg.norm(grid[0] - grid[1], axis=1)
        beyond = _refined(image, 2 * grid[0] - grid[1], radius_px)
        if _is_board(image, Corners(np.concatenate([beyond[None], grid[:-1]]))):
            return True
    return False


_LEAST_CONTRAST = 0.04
"""σ⁴(Hxy² − Hxx Hyy) over the variance around: about 0.4 where four sharp squares meet."""

_SURROUNDINGS = 2.0
_FARTHEST = 1.5
_NARROWEST_RAD = np.radians(25)
_MOST = 4000
_FIT_SAMPLES = 21
_FIT_STEPS = 6


class _Saddles(NamedTuple):
    """N saddle points of an image, the clearest first: positions x, y; angles of the four edges of
    each, radians, in turn from x to y (clockwise in the image), the first two and their opposites;
    and whether the quarter between the first two edges is the brighter one."""

    pixels: Points
    angles: Float[np.ndarray, "n 4"]
    bright: Bool[np.ndarray, " n"]


def _at_scales(image: Float[np.ndarray, "h w"]) -> Iterator[_Saddles]:
    """Saddle points of the image, from coarse to fine; positions in pixels of the image."""
    longest = max(image.shape)
    for reduction in (2**level for level in reversed(range(16))):
        if not _SMALLEST_PX * reduction <= longest <= _LARGEST_PX * reduction:
            continue
        small = image
        if reduction > 1:
            blurred = gaussian_filter(image, reduction / 2)
            small = zoom(blurred, 1 / reduction, order=1, grid_mode=True, mode="nearest")
        scale = np.array(image.shape[::-1]) / small.shape[::-1]
        for sigma_px in _SIGMAS_PX:
            found = _find_saddles(small, sigma_px)
            yield found._replace(pixels=found.pixels * scale)


def _find_saddles(image: Float[np.ndarray, "h w"], sigma_px: float) -> _Saddles:
    """The saddle points of an image after a Gaussian blur, where the Hessian's determinant is most
    negative (Chen and Zhang, 2005). In its asymptotic directions the image neither rises nor falls:
    these are the edges between squares, also in perspective. Along φ the second derivative is mean
    + half · cos 2(φ − main), which vanishes at two angles from main."""
    orders = ((0, 2), (1, 1), (2, 0), (0, 1), (1, 0))
    derivatives = np.stack([gaussian_filter(image, sigma_px, order=order) for order in orders])
    strength = (derivatives[1] ** 2 - derivatives[0] * derivatives[2]) * sigma_px**4
    smooth = gaussian_filter(image, _SURROUNDINGS * sigma_px)
    variance = gaussian_filter((image - smooth) ** 2, _SURROUNDINGS * sigma_px)
    contrast = strength / (variance + 1e-9 * image.var() + 1e-30)
    peak = strength == maximum_filter(strength, size=2 * round(sigma_px) + 1)
    row, column = np.nonzero(peak & (contrast > _LEAST_CONTRAST))
    best = np.argsort(-contrast[row, column], kind="stable")[:_MOST]
    row, column = row[best], column[best]
    found = derivatives[:, row, column]
    offset = _stationary(*found)
    xx, xy, yy = found[:3]
    mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    main = np.arctan2(2 * xy, xx - yy) / 2
    opening = np.arccos(np.clip(-mean / np.maximum(half, 1e-30), -1, 1)) / 2
    pair = np.sort(np.stack([main - opening, main + opening], axis=1) % np.pi, axis=1)
    bright = mean + half * np.cos(2 * (pair.mean(axis=1) - main)) > 0
    width = pair[:, 1] - pair[:, 0]
    kept = np.abs(offset).max(axis=1) < _FARTHEST
    kept &= (width > _NARROWEST_RAD) & (width < np.pi - _NARROWEST_RAD)
    pixels = np.column_stack([column, row]) + 0.5 + offset
    return _Saddles(pixels[kept], np.hstack([pair, pair + np.pi])[kept], bright[kept])


def _refined(
    image: Float[np.ndarray, "h w"], pixels: Points, radius_px: Float[np.ndarray, " n"]
) -> Points:
    """Saddle points to a fraction of a pixel, NaN where there is none within the radius: the next
    centre is the stationary point of a second-degree polynomial fitted around with Gaussian weights
    (Lucchese and Mitra, 2002)."""
    grid = np.linspace(-1, 1, _FIT_SAMPLES)
    x, y = (values.ravel() for values in np.meshgrid(grid, grid))
    weight = np.exp(-2 * (x**2 + y**2)) * (x**2 + y**2 <= 1)
    terms = np.column_stack([x * x / 2, x * y, y * y / 2, x, y, np.ones_like(x)])
    solve = np.linalg.pinv(terms * weight[:, None]) * weight
    radius, found = radius_px[:, None], pixels.copy()
    for _ in range(_FIT_STEPS):
        values = sampled(image, found[:, :1] + radius * x, found[:, 1:] + radius * y)
        fit = np.einsum("ks,ns->kn", solve, values)
        is_saddle = fit[1] ** 2 > fit[0] * fit[2]
        step = np.where(is_saddle[:, None], _stationary(*fit[:5]) * radius, np.nan)
        found += np.clip(step, -radius, radius)
        found[np.abs(found - pixels).max(axis=1) > radius_px] = np.nan
    return found


def _stationary(
    xx: np.ndarray, xy: np.ndarray, yy: np.ndarray, x: np.ndarray, y: np.ndarray
) -> Points:
    """Where polynomials with these derivatives at 0 are stationary."""
    with np.errstate(all="ignore"):
        return np.column_stack([xy * y - yy * x, xy * x - xx * y]) / (xx * yy - xy**2)[:, None]


_NEAREST = 16
_DEVIATION_RAD = np.radians(20)
_TURN_RAD = np.radians(25)
_NO = -1
_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))


def _lattices(saddles: _Saddles) -> list[_Lattice]:
    """Groups of saddle points that are neighbours of each other along their edges, the largest
    first; columns count along the edges' first direction, rows along the second, clockwise from it
    in the image."""
    if len(saddles.pixels) < 2:
        return []
    links, turns = _links(saddles)
    left = set(np.flatnonzero((links != _NO).sum(axis=1) >= 2).tolist())
    found = []
    while left:
        queue = [min(left)]
        cells, turned = {(0, 0): queue[0]}, {queue[0]: 0}
        places = {queue[0]: (0, 0)}
        while queue:
            point = queue.pop(0)
            for edge, neighbour in enumerate(links[point].tolist()):
                right, down = _STEPS[(edge - turned[point]) % 4]
                cell = places[point][0] + right, places[point][1] + down
                if neighbour == _NO or neighbour in places or cell in cells:
                    continue
                cells[cell], places[neighbour] = neighbour, cell
                turned[neighbour] = turned[point] + int(turns[point, edge])
                queue.append(neighbour)
        left -= places.keys()
        found.append(_Lattice(np.array(list(cells)), np.array(list(cells.values()))))
    return sorted(found, key=lambda lattice: -len(lattice.points))


def _links(saddles: _Saddles) -> tuple[Int[np.ndarray, "n 4"], Int[np.ndarray, "n 4"]]:
    """For each saddle point and edge: the neighbour at its other end (-1 without one), and by how
    many quarters its edges are numbered differently. It is the nearest point along the edge with
    edges alike and bright and dark quarters swapped, if the relation is mutual."""
    pixels, angles, bright = saddles
    count = len(pixels)
    near = cKDTree(pixels).query(pixels, k=min(_NEAREST + 1, count))[1][:, 1:]
    offset = pixels[near] - pixels[:, None]
    bearing = np.arctan2(offset[..., 1], offset[..., 0])
    along = _apart(bearing[:, None], angles[:, :, None]) < _DEVIATION_RAD
    first = _apart(angles[near], angles[:, None, :1])
    turn = first.argmin(axis=2)
    second = np.take_along_axis(angles[near], (turn[..., None] + 1) % 4, axis=2)[..., 0]
    alike = (first.min(axis=2) < _TURN_RAD) & (_apart(second, angles[:, None, 1]) < _TURN_RAD)
    swapped = bright[near] ^ (turn % 2 == 1) ^ bright[:, None]
    fits = along & (alike & swapped)[:, None]
    nearest = fits.argmax(axis=2)
    links = np.where(fits.any(axis=2), np.take_along_axis(near, nearest, axis=1), _NO)
    turns = np.take_along_axis(turn, nearest, axis=1)
    back = links[links, (np.arange(4) + 2 + turns) % 4]
    mutual = (links != _NO) & (back == np.arange(count)[:, None])
    return np.where(mutual, links, _NO), turns


def _apart(angle: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The angle between two directions, radians."""
    return np.abs((angle - other + np.pi) % (2 * np.pi) - np.pi)
