"""The modules of a photovoltaic plant in a map from above, found by their grid: rectangles whose
four borders differ in colour and in temperature from what is just inside."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy import ndimage, sparse
from scipy.spatial import KDTree

from mrgs.errors import RunError

Plane: TypeAlias = Float32[np.ndarray, "h w"]
Pairs: TypeAlias = Int64[np.ndarray, "p 2"]
Vectors: TypeAlias = Float64[np.ndarray, "n 2"]
"""In the turned raster: along the rows and across them, pixels or modules."""

SIDE_PX = 16
"""Pixels on a module's shorter side in the raster that is turned along the rows."""

INSIDE_PX, SLACK_PX = 2, 2
"""A border is compared with what is so far inside, and looked for so far from its place."""

LEAST_SCORE, WEAKER, WEAKEST, SUPPORTED = 3.0, 0.4, 0.12, 1.0
"""Standard deviations by which the weakest border of a module stands out; at least these shares of
what is usual for modules, and what is strong; and by how many between modules that were found."""

TILTS = [side for f in np.arange(1.0, 0.49, -0.05) for side in ((f, 1.0), (1.0, f))]
"""Sides of a tilted module as seen from above, as shares."""

FITS, ALIGNED, GAP, HOLE = 0.1, 0.2, 0.15, 0.3
"""Shares of a module: by which it may differ from its stated size and from its place beside its
neighbour, the widest gap within a table, and by how much a hole for one may be too narrow."""

JUMP, FEWEST = 3.3, 4
"""Widths within which the next module still is in the row; fewer modules are not a plant."""

REACH, STRAY_M, ROUNDS = 3, 0.02, 12
"""The grid about a module is fitted to those at most so many places away, with weights that fall
beyond so many metres, in so many rounds."""


class Modules(NamedTuple):
    """The M modules of a plant, in the order of their numbers.

    Attributes:
        corners: map coordinates and height, [M, 4, 3]: first the two of the side where the next
            rows are, in the order of the places, then the two of the other side, backwards.
        numbers: row, from north to south; line in the row, where modules stand above each other;
            and place, from west to east; [M, 3], from 1 on. Where rows run rather from south to
            north, so do places, and rows count from west to east.
    """

    corners: Float64[np.ndarray, "m 4 3"]
    numbers: Int64[np.ndarray, "m 3"]

    @property
    def sides(self) -> Float64[np.ndarray, "2"]:
        """Usual lengths along the row and across it, metres."""
        sides = self.corners[:, (1, 3)] - self.corners[:, :1]
        found: Float64[np.ndarray, "2"] = np.median(np.linalg.norm(sides, axis=2), axis=0)
        return found


def find_modules(
    celsius: Plane,
    colors: Float32[np.ndarray, "3 h w"],
    heights: Plane,
    pixel_m: float,
    size_m: tuple[float, float],
) -> Modules:
    """Find modules of a size in a map whose coordinates begin at its upper left corner, x to the
    right and y up, metres. Temperatures, °C, and colours, 0 to 255, are NaN where none is known;
    heights, metres, must be right at the borders of modules. RunError if there are none."""
    known, gray = np.isfinite(celsius), np.nan_to_num(colors).mean(axis=0)
    step = min(size_m) / SIDE_PX
    # Frames mirror the sky: they are colder than glass in the sun, and mostly brighter.
    layers = [np.where(known, -celsius, -np.median(celsius[known] if known.any() else 0.0)), gray]
    angle = _direction(layers)
    axes = np.array([[np.cos(angle), np.sin(angle)], [np.sin(angle), -np.cos(angle)]])
    height, width = known.shape
    reach = (np.abs(axes) @ (width, height) / 2 * pixel_m / step).astype(int) + 4 * SIDE_PX
    first = pixel_m / 2 * np.array([width, -height]) - step * reach @ axes
    matrix = step / pixel_m * (axes * (1, -1)).T[::-1, ::-1]
    offset, shape = (first * (1, -1) / pixel_m - 0.5)[::-1], tuple(2 * reach[::-1] + 1)
    turned = [
        ndimage.affine_transform(each, matrix, offset, shape, np.float32, 1, "nearest")
        for each in layers
    ]
    inside = ndimage.affine_transform(known, matrix, offset, shape, order=0)
    at, scores, sides = _peaks(_Borders(turned, inside), np.array(size_m) / step)
    _, steps = _pairs(at[scores > LEAST_SCORE], sides, 1.6)
    beside = [_adjacent(steps[:, order], 2 * ALIGNED, False).sum() for order in ([0, 1], [1, 0])]
    if beside[1] * sides[1] > beside[0] * sides[0]:
        at, axes, sides = at[:, ::-1] * (-1, 1), np.stack([-axes[1], axes[0]]), sides[::-1]
    at = _complete(at, scores, sides)
    if len(at) < FEWEST:
        raise RunError(
            f"no grid of modules of {size_m[0]:g} × {size_m[1]:g} m is on the map: state their "
            f"size, and see whether a map from above shows their frames",
            options=("module",),
        )
    found = _in_space(at, sides, step * axes, first, heights, pixel_m)
    low, high = sorted(found.sides.tolist())
    if np.abs(np.divide([low, high], sorted(size_m)) - 1).max() > FITS:
        raise RunError(
            f"the modules on the map are about {low:.2f} × {high:.2f} m, not {size_m[0]:g} × "
            f"{size_m[1]:g} m: state the size in their data sheet",
            options=("module",),
        )
    return found


def _direction(layers: list[Plane]) -> float:
    """The angle of the modules' sides, counter-clockwise from x, within 45°: of the steep slopes,
    all four directions count alike."""
    total = 0j
    for each in layers:
        image = ndimage.gaussian_filter(each, 1.0)
        slope = ndimage.sobel(image, 1) - 1j * ndimage.sobel(image, 0)
        steep = slope[np.abs(slope) > np.quantile(np.abs(slope), 0.9)]
        total += (steep**4 / np.abs(steep) ** 3).sum() / max(np.abs(steep).sum(), 1e-9)
    return float(np.angle(total)) / 4


class _Borders:
    """How far the borders of modules stand out in a raster, in standard deviations."""

    def __init__(self, layers: list[Plane], inside: Bool[np.ndarray, "h w"]) -> None:
        self.inside = inside
        texture = [ndimage.gaussian_laplace(each, 1.0)[inside] for each in layers]
        images = np.stack([a / _spread(b) for a, b in zip(layers, texture, strict=True)])
        self._lines, self.near, self._within = [], [], []
        for axis, sign in ((1, 1), (1, -1), (0, 1), (0, -1)):  # left, right, top and bottom
            step = images - np.roll(images, -sign * INSIDE_PX, 1 + axis)
            lines = ndimage.uniform_filter1d(step, round(0.7 * SIDE_PX), axis=2 - axis)
            line, unit = lines.sum(axis=0), _spread(lines.sum(axis=0)[inside])
            self._lines.append(line / unit)
            self.near.append(ndimage.maximum_filter1d(line / unit, 2 * SLACK_PX + 1, axis=axis))
            # Hot cells have edges in one layer alone: no borders of smaller modules.
            self._within.append(lines.min(axis=0) * len(lines) / unit)

    def score(self, sides: Float64[np.ndarray, "2"]) -> Plane:
        """Of modules in the middle of each pixel: by how much their weakest border stands out, less
        the strongest line inside."""
        found = np.full(self.near[0].shape, np.inf, np.float32)
        for number, (near, within) in enumerate(zip(self.near, self._within, strict=True)):
            axis = 1 - number // 2
            half = round(sides[1 - axis] / 2)
            width = max(2 * (half - INSIDE_PX - SLACK_PX - 1), 1)
            line = np.roll(near, half if number % 2 == 0 else -half, axis)
            line -= ndimage.maximum_filter1d(within, width, axis=axis).clip(0)
            np.minimum(found, line, out=found)
        return found

    def middles(
        self, rows: np.ndarray, columns: np.ndarray, sides: np.ndarray, sure: np.ndarray
    ) -> Vectors:
        """Middles of modules near pixels: by each border, and where most of the ``sure`` ones have
        the other."""
        found, steps = [], np.arange(-SLACK_PX - 1, SLACK_PX + 2)
        for axis, side in ((1, sides[0]), (0, sides[1])):
            ends, weights = [], []
            for number, sign in ((2 - 2 * axis, -1), (3 - 2 * axis, 1)):
                at = [rows[:, None], columns[:, None]]
                at[axis] = at[axis] + sign * round(side / 2) + steps
                share = self._lines[number][tuple(at)].clip(1e-3) ** 2
                share /= share.sum(axis=1, keepdims=True)
                ends.append((share * at[axis]).sum(axis=1))
                spread = (share * (at[axis] - ends[-1][:, None]) ** 2).sum(axis=1)
                weights.append(1 / (spread + 0.1))
            usual = np.median((ends[1] - ends[0])[sure]) if sure.any() else side
            between = ends[0] + usual / 2, ends[1] - usual / 2
            found.append(np.average(between, axis=0, weights=weights))
        return np.stack(found, axis=1)


def _spread(values: Float32[np.ndarray, " n"]) -> float:
    """The standard deviation by the median, above 0."""
    middle = np.median(values) if values.size else 0.0
    return max(float(np.median(np.abs(values - middle))) / 0.6745, 1e-6) if values.size else 1.0


def _peaks(
    borders: _Borders, size_px: Float64[np.ndarray, "2"]
) -> tuple[Vectors, Float64[np.ndarray, " n"], Float64[np.ndarray, "2"]]:
    """Middles of what looks like modules of a size, mounted upright or across and tilted by any
    angle, their scores, and the sides of most."""
    shapes = [size_px[[n, 1 - n]] * tilt for n in (0, 1) for tilt in TILTS]
    totals = [(borders.score(each) - LEAST_SCORE).clip(0).sum() * each.prod() for each in shapes]
    sides = shapes[int(np.argmax(totals))]
    score = borders.score(sides)
    score += 0.01 * ndimage.gaussian_filter(score, 1.5)  # the middle of equal ones
    peak = borders.inside & (
        score == ndimage.maximum_filter(score, np.rint(0.7 * sides[::-1]).astype(int))
    )
    rows, columns = np.nonzero(peak & (score > SUPPORTED))
    scores = score[rows, columns].astype(float)
    if (scores > LEAST_SCORE).any():
        strong = np.percentile([near[borders.inside] for near in borders.near], 99)
        if np.median(scores[scores > LEAST_SCORE]) < WEAKEST * strong:
            scores[:] = 0.0  # cells have borders, too
    return borders.middles(rows, columns, sides, scores > LEAST_SCORE), scores, sides


def _pairs(at: Vectors, sides: Float64[np.ndarray, "2"], most: float) -> tuple[Pairs, Vectors]:
    """Pairs at most so many widths apart, and the steps from one to the other, in modules."""
    pairs = KDTree(at).query_pairs(most * sides.max(), output_type="ndarray")
    return pairs, (at[pairs[:, 1]] - at[pairs[:, 0]]) / sides


def _adjacent(steps: Vectors, gap: float, across: bool = True) -> Bool[np.ndarray, " n"]:
    """Whether modules lie side by side, or also ``across``: one above the other."""
    away = np.abs(np.abs(steps)[:, None] - np.eye(2))
    beside = (away < np.array([[gap, ALIGNED], [ALIGNED, gap]])).all(axis=2)
    return beside.any(axis=1) if across else beside[:, 0]


def _linked(steps: Vectors) -> Bool[np.ndarray, " n"]:
    """Whether modules are neighbours in a table, or next to each other in a row."""
    along, across = np.abs(steps).T
    return _adjacent(steps, ALIGNED) | (across < ALIGNED) & (along > 1 - ALIGNED) & (along < JUMP)


def _complete(
    at: Vectors, scores: Float64[np.ndarray, " n"], sides: Float64[np.ndarray, "2"]
) -> Vectors:
    """The places that certainly are modules of a row, and those beside at least two of them near
    which something stands out less."""
    certain = at[scores > LEAST_SCORE]
    if len(certain):
        certain = at[scores > max(LEAST_SCORE, WEAKER * np.median(scores[scores > LEAST_SCORE]))]
    pairs, steps = _pairs(certain, sides, JUMP)
    graph = sparse.coo_array(
        (np.ones(_linked(steps).sum()), pairs[_linked(steps)].T), shape=(len(certain),) * 2
    )
    piece = sparse.csgraph.connected_components(graph, directed=False)[1]
    sure = certain[np.bincount(piece)[piece] >= FEWEST] if len(certain) else certain
    if not len(sure):
        return sure
    spots = np.concatenate([sure + way * sides for way in (*np.eye(2), *-np.eye(2))])
    spots = spots[KDTree(sure / sides).query(spots / sides)[0] > 0.5]
    found = KDTree(spots / sides).query_ball_point(at / sides, 0.35)
    places = {
        tuple(spots[each].mean(axis=0))
        for each in found
        if len(each) > 1 and np.ptp(spots[each] / sides, axis=0).max() < ALIGNED
    }
    every = np.concatenate([sure, np.array(sorted(places)).reshape(-1, 2)])
    twice = KDTree(every / sides).query_pairs(0.5, output_type="ndarray")  # near one place
    return np.delete(every, twice[:, 1], axis=0)


def _numbered(at: Vectors, sides: Float64[np.ndarray, "2"]) -> tuple[np.ndarray, np.ndarray]:
    """Row, line and place of modules, [N, 3], and the table of each: by steps from neighbour to
    neighbour in a row, and by the middles of what is linked."""
    count = len(at)
    pairs, steps = _pairs(at, sides, JUMP)

    def graph(chosen: Bool[np.ndarray, " p"]) -> sparse.csr_array:
        lengths = np.abs(steps[chosen]).sum(axis=1)
        return sparse.csr_array((lengths, pairs[chosen].T), shape=(count, count))

    table = sparse.csgraph.connected_components(graph(_adjacent(steps, GAP)), directed=False)[1]
    links = sparse.csgraph.minimum_spanning_tree(graph(_linked(steps)))
    pieces, piece = sparse.csgraph.connected_components(links, directed=False)
    numbers, row_of = np.zeros((count, 3), int), _rows(at[:, 1] / sides[1], piece)
    for each in range(pieces):
        root = int(np.flatnonzero(piece == each)[0])
        order, before = sparse.csgraph.breadth_first_order(links, root, directed=False)
        for one in order[1:]:
            way = (at[one] - at[before[one]]) / sides
            way = np.sign(way) * np.floor(np.abs(way) + np.array([HOLE, 0.5]))
            numbers[one, :0:-1] = numbers[before[one], :0:-1] + way
        numbers[order, 1:] -= numbers[order, 1:].min(axis=0) - 1
        numbers[order, 0], above = row_of[each]
        numbers[order, 1] += above
    taken = np.zeros(numbers[:, 0].max() + 1, int)
    for each in sorted(range(pieces), key=lambda each: np.median(at[piece == each, 0])):
        numbers[piece == each, 2] += taken[numbers[piece == each, 0]]
        taken[numbers[piece == each, 0]] = numbers[piece == each, 2].max()
    return numbers, table


def _rows(levels: Float64[np.ndarray, " n"], piece: np.ndarray) -> dict[int, tuple[int, int]]:
    """The row of each piece, from 1, and how many lines of its row lie above it; ``levels`` are
    those of modules, in modules. What lies on the levels of a row belongs to it."""
    pieces = [levels[piece == each] for each in range(piece.max() + 1)]
    tops, bottoms = (np.array([end(each) for each in pieces]) for end in (np.min, np.max))
    rows: list[list[int]] = []
    for each in np.argsort(tops + bottoms).tolist():
        if not rows or tops[each] > bottoms[rows[-1]].max() + 0.5:
            rows.append([])
        rows[-1].append(each)
    return {
        each: (number, round(tops[each] - tops[row].min()))
        for number, row in enumerate(rows, 1)
        for each in row
    }


def _in_space(
    at: Vectors,
    sides: Float64[np.ndarray, "2"],
    axes: Float64[np.ndarray, "2 2"],
    first: Float64[np.ndarray, "2"],
    heights: Plane,
    pixel_m: float,
) -> Modules:
    """Modules by a plane grid about each, at the heights of their borders: a model may show glass
    without texture deeper than it is, but not frames."""
    numbers, table = _numbered(at, sides)
    order = np.lexsort(numbers.T[::-1])
    numbers, table, places = numbers[order], table[order], first + at[order] @ axes
    near = [
        np.flatnonzero((table == table[n]) & (np.abs(numbers[:, 2] - place) <= REACH))
        for n, (*_, place) in enumerate(numbers)
    ]
    steps = np.array([(s, t) for t in np.linspace(-0.45, 0.45, 10) for s in (-0.5, 0.5)])
    steps = np.concatenate([steps, steps[:, ::-1]])
    grids = np.empty((len(at), 3, 2))
    for n, others in enumerate(near):
        away = numbers[others][:, :0:-1] - numbers[n, :0:-1]
        design = np.vstack([np.eye(3)[1:], np.column_stack([np.ones(len(away)), away])])
        grids[n] = _robust(design, np.vstack([sides[:, None] * axes, places[others]]))
    borders = grids[:, None, 0] + steps @ grids[:, 1:]
    pixels = np.rint(borders / pixel_m * (1, -1) - 0.5).astype(int)
    upper = ndimage.maximum_filter(np.where(np.isfinite(heights), heights, -np.inf), 3)
    rows, columns = (pixels[..., n].clip(0, heights.shape[1 - n] - 1) for n in (1, 0))
    z = upper[rows, columns]
    corners = np.empty((len(at), 4, 3))
    signs = np.array([(-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)])
    for n, others in enumerate(near):
        known = np.isfinite(z[others])
        around = (borders[others] - grids[n, 0])[known]
        plane = _robust(np.column_stack([np.ones(len(around)), around]), z[others][known][:, None])
        offsets = signs @ grids[n, 1:]
        corners[n] = np.column_stack([grids[n, 0] + offsets, plane[0] + offsets @ plane[1:]])
    return Modules(corners, numbers)


def _robust(
    design: Float64[np.ndarray, "n k"], values: Float64[np.ndarray, "n c"]
) -> Float64[np.ndarray, "k c"]:
    """Least squares with weights that fall with the residual (Cauchy)."""
    weights = np.ones((len(design), 1))
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        found = np.linalg.lstsq(root * design, root * values, rcond=None)[0]
        away = np.linalg.norm(values - design @ found, axis=1, keepdims=True)
        weights = 1 / (1 + (away / STRAY_M) ** 2)
    return found
