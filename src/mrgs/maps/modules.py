"""The modules of a photovoltaic plant in a map from above, found by their grid.

A module is a rectangle whose four borders differ from what is just inside: by the colour of frames
and gaps, and by their temperature. Neighbours make a table, which is plane, and tables make a row.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy import ndimage, sparse
from scipy.spatial import KDTree

from mrgs.errors import RunError

TILE_M = 20.0
"""Side of the squares in which the direction of rows is found."""

SIDE_PX = 16
"""Pixels of the rasters, turned along the rows, on a module's shorter side."""

LEAST_KNOWN = 0.01
"""Share of a square that shows a surface; others are left out."""

INSIDE_PX = 2
"""A border is compared with what is so far inside."""

SLACK_PX = 2
"""Borders are looked for so far from where they should be."""

FORESHORTENED = (1.0, 0.92, 0.84, 0.76, 0.68, 0.6, 0.52)
"""Depths of a tilted module from above, as shares of its height."""

LEAST_SCORE = 3.0
"""Of the weakest border of a module, in standard deviations of what the map shows elsewhere."""

SUPPORTED = 1.0
"""The same for a place between modules that were found."""

FITS = 0.06
"""Share by which modules may be longer or shorter than stated."""

ALIGNED = 0.2
"""Share of a module by which neighbours may be displaced."""

GAP = 0.15
"""Widest gap between modules of one table, as a share of a module."""

JUMP = 3.3
"""Modules at most so many widths apart, with nothing between them, are in one row."""

HOLE = 0.3
"""A missing module may be narrower by this share: 2.7 widths to the next are three places."""

REACH, EDGE = 3, np.linspace(-0.45, 0.45, 10)
"""Modules so many places away count in the grid about one; where its borders are looked at."""

STRAY_M, ROUNDS = 0.02, 12
"""Residual from which on a place of the grid or a height counts less, metres."""

FEWEST = 4
"""Fewer modules are no plant."""


class Modules(NamedTuple):
    """The M modules of a plant, in the order of their numbers, which begin at 1.

    Attributes:
        corners: lower left, lower right, upper right and upper left one, map coordinates and
            height, [M, 4, 3]; the lower side is the one to the south, or to the west where rows run
            from north to south.
        row: from north to south, or from west to east.
        line: of the row, where modules stand above each other: from the upper side on.
        place: in the row, from west to east, or from north to south.
        table: to which it belongs; tables are planes.
    """

    corners: Float64[np.ndarray, "m 4 3"]
    row: Int64[np.ndarray, " m"]
    line: Int64[np.ndarray, " m"]
    place: Int64[np.ndarray, " m"]
    table: Int64[np.ndarray, " m"]


class _Candidates(NamedTuple):
    """Rectangles that look like modules: middles [N, 2], unit vectors along the row [N, 2], sides
    along the row and across it from above [N, 2], all in map metres; and scores."""

    middles: Float64[np.ndarray, "n 2"]
    along: Float64[np.ndarray, "n 2"]
    sides: Float64[np.ndarray, "n 2"]
    score: Float64[np.ndarray, " n"]

    def chosen(self, rows: np.ndarray) -> _Candidates:
        return _Candidates(*(each[rows] for each in self))


class _Borders:
    """How far the borders of modules stand out in a raster turned along the rows."""

    def __init__(
        self, layers: Float[np.ndarray, "c h w"], known: Bool[np.ndarray, "h w"]
    ) -> None:
        images = np.stack([_whitened(each, known) for each in layers])
        length, size = round(0.7 * SIDE_PX), 2 * SLACK_PX + 1
        self.of_side, self._inside, self._near = [], [], []
        for axis, sign in product((1, 0), (1, -1)):  # left, right, top and bottom
            step = images - np.roll(images, -sign * INSIDE_PX, 1 + axis)
            line = ndimage.uniform_filter1d(step, length, axis=2 - axis)
            self.of_side.append(line.sum(axis=0) / _spread(line.sum(axis=0)[known]))
            # A hot third has an edge in one layer alone, modules in all that show them.
            self._inside.append(line.min(axis=0) * len(line) / _spread(line.sum(axis=0)[known]))
            self._near.append(ndimage.maximum_filter1d(self.of_side[-1], size, axis=axis))

    def score(self, width: float, height: float) -> Float[np.ndarray, "h w"]:
        """Of modules in the middle of each pixel: by how much their weakest border stands out, less
        the strongest line inside."""
        found = np.full(self.of_side[0].shape, np.inf)
        for axis, side in ((1, width), (0, height)):
            half = round(side / 2)
            within = max(2 * (half - 2 * SLACK_PX - 1), 1)
            for number, sign in ((2 * (1 - axis), 1), (2 * (1 - axis) + 1, -1)):
                line = np.roll(self._near[number], sign * half, axis)
                inside = ndimage.maximum_filter1d(self._inside[number], within, axis=axis)
                np.minimum(found, line - inside.clip(0), out=found)
        return found

    def measured(
        self, rows: np.ndarray, columns: np.ndarray, sides: tuple[float, float], sure: np.ndarray
    ) -> tuple[Float64[np.ndarray, "n 2"], list[float]]:
        """Middles (x, y) of modules about pixels, by their borders, and the sides that most of the
        ``sure`` ones have, pixels."""
        steps = np.arange(-SLACK_PX - 1, SLACK_PX + 2)
        middles, usual = [], []
        for axis, side in ((1, sides[0]), (0, sides[1])):
            ends, weights = [], []
            for number, sign in ((2 - 2 * axis, -1), (3 - 2 * axis, 1)):
                at = [rows[:, None], columns[:, None]]
                at[axis] = at[axis] + sign * round(side / 2) + steps
                share = self.of_side[number][tuple(at)].clip(1e-3) ** 2
                share /= share.sum(axis=1, keepdims=True)
                ends.append((share * at[axis]).sum(axis=1))
                spread = (share * (at[axis] - ends[-1][:, None]) ** 2).sum(axis=1)
                weights.append(1 / (spread + 0.1))
            usual.append(float(np.median((ends[1] - ends[0])[sure])) if sure.any() else side)
            low, high = ends[0] + usual[-1] / 2, ends[1] - usual[-1] / 2
            middles.append(np.average([low, high], axis=0, weights=weights))
        return np.stack(middles, axis=1), usual


def _whitened(
    image: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """An image in standard deviations of its texture."""
    return image / _spread(ndimage.gaussian_laplace(image, 1.0)[known])


def _spread(values: Float[np.ndarray, "..."]) -> float:
    """Standard deviation by the median, whatever a few outliers are; above 0."""
    return max(float(np.median(np.abs(values - np.median(values)))) / 0.6745, 1e-6)


def find_modules(
    celsius: Float32[np.ndarray, "h w"],
    colors: Float32[np.ndarray, "3 h w"],
    heights: Float32[np.ndarray, "h w"],
    pixel_m: float,
    size_m: tuple[float, float],
) -> Modules:
    """Find the modules in a map, whose coordinates are x to the right and y up from the upper left
    corner, metres.

    Args:
        celsius: temperatures, NaN where there is no surface.
        colors: 0 to 255, NaN where there is no surface or no colour.
        heights: of the surface, metres; exact at the frames of modules at least.
        pixel_m: side of a pixel.
        size_m: the sides of a module.

    Raises:
        RunError: there are no modules of this size.
    """
    gray = np.nan_to_num(colors).mean(axis=0)
    known = np.isfinite(celsius)
    if not known.any():
        raise RunError("no temperatures are on the map: no modules can be found")
    # Frames mirror the sky: they are colder than glass in the sun, and mostly brighter.
    layers = [-np.where(known, celsius, np.median(celsius[known])), gray]
    found = [each for each in _tiles(layers, known, pixel_m, size_m) if len(each.score)]
    if not found:
        raise _none(size_m)
    found = _Candidates(*map(np.concatenate, zip(*found, strict=True)))
    found = _complete(_along_rows(_best_of_each_place(found)))
    if len(found.score) < FEWEST:
        raise _none(size_m)
    return _in_space(*_numbered(found), heights, pixel_m)


def _none(size_m: tuple[float, float]) -> RunError:
    return RunError(
        f"no grid of modules of {size_m[0]:g} × {size_m[1]:g} m is on the map: state their size, "
        f"and see whether the map from above shows their frames",
        options=("module",),
    )


def _tiles(
    layers: list[np.ndarray],
    known: Bool[np.ndarray, "h w"],
    pixel_m: float,
    size_m: tuple[float, float],
) -> Iterator[_Candidates]:
    """The rectangles in each square of the map that look like modules."""
    side, step = round(TILE_M / pixel_m), min(size_m) / SIDE_PX
    zoom = step / pixel_m
    reach = round((TILE_M / 2**0.5 + 1.5 * max(size_m)) / step)
    for top, left in product(*(range(0, size, side) for size in known.shape)):
        part = slice(top, top + side), slice(left, left + side)
        if known[part].mean() < LEAST_KNOWN:
            continue
        angle = _direction([each[part] for each in layers])
        x, y = np.array([np.cos(angle), -np.sin(angle)]), np.array([np.sin(angle), np.cos(angle)])
        middle = np.array([left, top]) + side / 2 - 0.5
        start = middle - reach * zoom * (x + y)
        matrix = zoom * np.array([[y[1], x[1]], [y[0], x[0]]])
        turned = [
            ndimage.affine_transform(
                each, matrix, start[::-1], (2 * reach + 1,) * 2, order=1, mode=mode
            )
            for each, mode in (*((each, "nearest") for each in layers), (known * 1.0, "constant"))
        ]
        borders = _Borders(np.stack(turned[:-1]), turned[-1] > 0.5)
        rows, columns, sides, score = _peaks(borders, np.array(size_m) / step)
        middles, usual = borders.measured(rows, columns, sides, score > LEAST_SCORE)
        at = start + zoom * (middles[:, :1] * x + middles[:, 1:] * y)
        inside = ((np.abs(at - middle) <= side / 2)).all(axis=1)
        along = np.repeat([x * (1, -1)], len(at), axis=0)
        places = (at + 0.5) * pixel_m * (1, -1)
        sizes = np.repeat([np.array(usual) * step], len(at), axis=0)
        yield _Candidates(places, along, sizes, score).chosen(inside)


def _direction(layers: list[np.ndarray]) -> float:
    """The angle of the rows or of what is square to them, counter-clockwise from x, radians."""
    total = 0.0 + 0.0j
    for each in layers:
        image = ndimage.gaussian_filter(each, 1.0)
        slope = ndimage.sobel(image, 1) - 1j * ndimage.sobel(image, 0)
        size = np.abs(slope)
        limit = np.quantile(size, 0.8)
        total += (slope[size > limit] ** 4 / size[size > limit].clip(1e-9) ** 3).sum() / max(
            float(size.sum()), 1e-9
        )
    return float(np.angle(total)) / 4


def _peaks(
    borders: _Borders, size_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[float, float], np.ndarray]:
    """Rows and columns of the modules in a raster, their sides as seen from above, and scores."""
    best: tuple = (-1.0,)
    edge = round(0.5 * size_px.max()) + SLACK_PX + 2
    flat = {(a, b) for a, b in (size_px, size_px[::-1])}
    shapes = {(a * f, b) for a, b in flat for f in FORESHORTENED}
    shapes |= {(a, b * f) for a, b in flat for f in FORESHORTENED}
    for sides in sorted(shapes):
        score = borders.score(*sides)[edge:-edge, edge:-edge]
        around = [round(0.7 * side) for side in sides[::-1]]
        peak = (score > SUPPORTED) & (score == ndimage.maximum_filter(score, around))
        total = float(score[peak & (score > LEAST_SCORE)].sum()) * sides[0] * sides[1]
        if total > best[0]:
            rows, columns = np.nonzero(peak)
            best = total, rows + edge, columns + edge, sides, score[peak].astype(np.float64)
    return best[1:]


def _best_of_each_place(found: _Candidates) -> _Candidates:
    """Without those that overlap a better one."""
    found = found.chosen(np.argsort(-found.score))
    near = KDTree(found.middles).query_pairs(0.7 * found.sides.min(), output_type="ndarray")
    dropped = np.zeros(len(found.score), bool)
    for better, worse in near[np.lexsort(near.T[::-1])]:
        dropped[worse] |= not dropped[better]
    return found.chosen(~dropped)


def _turned(found: _Candidates, axis: Float64[np.ndarray, "2"]) -> _Candidates:
    """The same rectangles, their rows along the sides that are nearest to a direction."""
    across = np.abs(found.along @ axis) < 0.5**0.5
    along = np.where(across[:, None], _clockwise(found.along), found.along)
    sides = np.where(across[:, None], found.sides[:, ::-1], found.sides)
    return found._replace(along=along * np.sign(along @ axis)[:, None], sides=sides)


def _clockwise(vectors: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    return vectors[:, ::-1] * (1, -1)


def _along_rows(found: _Candidates) -> _Candidates:
    """The candidates turned along the rows, in which most have neighbours: towards the east, or
    the north where rows run so."""
    weights = np.where(found.score > LEAST_SCORE, found.score, 0.0)
    angle = np.angle(weights @ (found.along @ (1, 1j)) ** 4) / 4
    axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    lengths = []
    for axis in axes:
        turned = _turned(found, axis)
        pairs, steps = _pairs(turned, 1.6)
        beside = (np.abs(np.abs(steps) - (1, 0)) < (0.5, ALIGNED)).all(axis=1)
        beside &= (weights[pairs] > 0).all(axis=1)
        lengths.append(turned.sides[pairs[beside, 0], 0].sum())
    axis = axes[np.argmax(lengths)]
    return _smoothed(_turned(found, axis * np.sign(axis[np.abs(axis).argmax()])))


def _smoothed(found: _Candidates) -> _Candidates:
    """With the directions and sides that are usual about each candidate: a square of the map may
    show little of a table."""
    count = len(found.score)
    pairs = KDTree(found.middles).query_pairs(TILE_M, output_type="ndarray")
    near = sparse.coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    weights = np.where(found.score > LEAST_SCORE, found.score, 1e-3)
    both = weights[:, None] * np.concatenate([found.along, found.sides], axis=1)
    total = both + near @ both + near.T @ both
    along, sides = total[:, :2], total[:, 2:] / (weights + near @ weights + near.T @ weights)[:, None]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    found = found._replace(along=along, sides=sides)
    # Blur moves borders inwards, but not the middles: those of neighbours tell the sides.
    pairs, steps = _pairs(found, 1.6)
    steps = np.abs(steps[(weights[pairs] > 1).all(axis=1)])
    for axis in (0, 1):
        beside = steps[(np.abs(steps - np.eye(2)[axis]) < ALIGNED).all(axis=1), axis]
        sides[:, axis] *= np.median(beside) if len(beside) else 1.0
    return found


def _steps(found: _Candidates, pairs: Int64[np.ndarray, "p 2"]) -> Float64[np.ndarray, "p 2"]:
    """From the first of each pair to the second, in modules along the row and across it."""
    first, second = pairs.T
    way = found.middles[second] - found.middles[first]
    axes = np.stack([found.along[first], _clockwise(found.along[first])], axis=1)
    return np.einsum("nij,nj->ni", axes, way) * 2 / (found.sides[first] + found.sides[second])


def _pairs(
    found: _Candidates, most: float
) -> tuple[Int64[np.ndarray, "p 2"], Float64[np.ndarray, "p 2"]]:
    """Pairs at most so many sides apart, and the steps between them."""
    reach = most * float(np.median(found.sides.max(axis=1)))
    pairs = KDTree(found.middles).query_pairs(reach, output_type="ndarray")
    return pairs, _steps(found, pairs)


def _adjacent(steps: Float64[np.ndarray, "p 2"], gap: float) -> Bool[np.ndarray, " p"]:
    """Whether modules lie side by side, or one above the other; ``gap`` is the widest between
    them, as a share of a module."""
    away = np.abs(np.abs(steps)[:, None] - np.eye(2))
    limits = np.array([[gap, ALIGNED], [ALIGNED, gap]])
    return (away < limits).all(axis=2).any(axis=1)


def _linked(steps: Float64[np.ndarray, "p 2"]) -> Bool[np.ndarray, " p"]:
    """Whether modules are in one row."""
    along, across = np.abs(steps).T
    return _adjacent(steps, ALIGNED) | (across < ALIGNED) & (along > 1 - ALIGNED) & (along < JUMP)


def _complete(found: _Candidates) -> _Candidates:
    """The candidates that certainly are in a row, and those between at least two of them that
    stand out less, or not where they should be."""
    pairs, steps = _pairs(found, JUMP)
    certain = found.score > LEAST_SCORE
    linked = pairs[_linked(steps) & certain[pairs].all(axis=1)]
    sure = found.chosen(np.unique(linked))
    across, sides = _clockwise(sure.along), sure.sides
    ways = np.concatenate([sure.along * sides[:, :1], across * sides[:, 1:]])
    spots = np.concatenate([sure.middles, sure.middles]).repeat(2, axis=0)
    spots = spots + np.stack([ways, -ways], axis=1).reshape(-1, 2)
    of = np.tile(np.arange(len(sure.score)), 2).repeat(2)
    limit = float(sides.min())
    free = KDTree(sure.middles).query(spots)[0] > 0.6 * limit
    spots, of = spots[free], of[free]
    near = KDTree(spots).query_pairs(0.3 * limit, output_type="ndarray")
    graph = sparse.coo_array((np.ones(len(near)), near.T), shape=(len(spots),) * 2)
    _, label = sparse.csgraph.connected_components(graph, directed=False)
    _, first, label, count = np.unique(label, return_index=True, return_inverse=True, return_counts=True)
    middles = np.stack([np.bincount(label, axis) for axis in spots.T], axis=1) / count[:, None]
    seen = KDTree(found.middles).query(middles)[0] < 0.35 * limit
    added = sure.chosen(of[first])._replace(middles=middles).chosen(seen & (count > 1))
    return _Candidates(*map(np.concatenate, zip(sure, added, strict=True)))


def _numbered(found: _Candidates) -> tuple[_Candidates, Int64[np.ndarray, "4 n"]]:
    """The modules in their order; their rows, lines and places from 1, and tables."""
    count = len(found.score)
    pairs, steps = _pairs(found, JUMP)
    adjacent, linked = _adjacent(steps, GAP), _linked(steps)

    def graph(chosen: Bool[np.ndarray, " p"]) -> sparse.csr_array:
        lengths = np.abs(steps[chosen]).sum(axis=1)
        return sparse.csr_array((lengths, pairs[chosen].T), shape=(count, count))

    _, table = sparse.csgraph.connected_components(graph(adjacent), directed=False)
    pieces, piece = sparse.csgraph.connected_components(graph(linked), directed=False)
    tree = sparse.csgraph.minimum_spanning_tree(graph(linked))
    at = np.zeros((count, 2), int)
    for number in range(pieces):
        root = int(np.flatnonzero(piece == number)[0])
        order, before = sparse.csgraph.breadth_first_order(tree, root, directed=False)
        way = _steps(found, np.stack([before[order[1:]], order[1:]], axis=1))
        way = np.sign(way) * np.floor(np.abs(way) + (HOLE, 0.5))
        for each, step in zip(order[1:], way.astype(int), strict=True):
            at[each] = at[before[each]] + step
        at[order] -= at[order].min(axis=0) - 1
    return _in_rows(found, piece, at, table)


def _in_rows(
    found: _Candidates,
    piece: Int64[np.ndarray, " n"],
    at: Int64[np.ndarray, "n 2"],
    table: Int64[np.ndarray, " n"],
) -> tuple[_Candidates, Int64[np.ndarray, "4 n"]]:
    """With the rows that pieces make, which are numbered each from 1 on."""
    along = found.along.mean(axis=0, keepdims=True) / np.linalg.norm(found.along.mean(axis=0))
    u, down = found.middles @ along[0], found.middles @ _clockwise(along)[0]
    count = piece.max() + 1
    level, first = (ndimage.labeled_comprehension(each, piece, range(count), how, float, 0) for each, how in ((down, np.median), (u, np.min)))
    by_level = np.argsort(level)
    begins = np.diff(level[by_level], prepend=-np.inf) > 0.5 * np.median(found.sides[:, 1])
    row_of = np.empty(count, int)
    row_of[by_level] = np.cumsum(begins)
    place, taken = at[:, 0].copy(), np.zeros(row_of.max() + 1, int)
    for number in np.argsort(first):
        inside = piece == number
        place[inside] += taken[row_of[number]]
        taken[row_of[number]] = place[inside].max()
    numbers = np.stack([row_of[piece], at[:, 1], place, table])
    order = np.lexsort(numbers[2::-1])
    return found.chosen(order), numbers[:, order]


def _in_space(
    found: _Candidates,
    numbers: Int64[np.ndarray, "4 n"],
    heights: Float32[np.ndarray, "h w"],
    pixel_m: float,
) -> Modules:
    """Modules by a plane grid about each, whose heights are those of the borders: glass without
    texture lies deeper in models, and frames do not."""
    row, line, place, table = numbers
    steps = np.concatenate([np.stack([EDGE, s * np.ones_like(EDGE)], 1) for s in (-0.5, 0.5)])
    steps = np.concatenate([steps, steps[:, ::-1]])
    count = len(row)
    grids, borders = np.empty((count, 3, 2)), np.empty((count, len(steps), 2))
    near = [_near(each, numbers) for each in range(count)]
    for each in range(count):
        others = near[each]
        at = np.stack([place, line], axis=1)[others] - (place[each], line[each])
        sides = np.median(found.sides[others], axis=0)
        axes = np.stack([found.along[each], _clockwise(found.along[each : each + 1])[0]])
        # The sides and directions that were measured count as one more module.
        design = np.vstack([np.eye(3)[1:], np.column_stack([np.ones(len(at)), at])])
        grids[each] = _robust(design, np.vstack([sides[:, None] * axes, found.middles[others]]))
        borders[each] = np.column_stack([np.ones(len(steps)), steps]) @ grids[each]
    columns, rows = np.moveaxis(borders, 2, 0) / pixel_m * np.array([1, -1])[:, None, None] - 0.5
    upper = ndimage.maximum_filter(np.where(np.isfinite(heights), heights, -np.inf), 3)
    z = upper[tuple(np.rint([rows, columns]).astype(int).clip(0, np.array(upper.shape)[:, None, None] - 1))]
    signs = np.array([(-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)])
    corners = np.empty((count, 4, 3))
    for each, others in enumerate(near):
        middle = grids[each, 0]
        known = np.isfinite(z[others])
        places = (borders[others] - middle)[known]
        plane = _robust(np.column_stack([np.ones(len(places)), places]), z[others][known][:, None])
        corners[each, :, :2] = signs @ grids[each, 1:]
        corners[each, :, 2] = plane[0] + corners[each, :, :2] @ plane[1:, 0]
        corners[each, :, :2] += middle
    return Modules(corners, row, line, place, table)


def _near(each: int, numbers: Int64[np.ndarray, "4 n"]) -> Int64[np.ndarray, " k"]:
    """The modules of the same table at most ``REACH`` places away, with itself."""
    _, _, place, table = numbers
    return np.flatnonzero((table == table[each]) & (np.abs(place - place[each]) <= REACH))


def _robust(
    design: Float64[np.ndarray, "n k"], values: Float64[np.ndarray, "n c"]
) -> Float64[np.ndarray, "k c"]:
    """Least squares with weights that fall with the residual (Cauchy), so that outliers hardly
    count."""
    weights = np.ones(len(design))
    for _ in range(ROUNDS):
        root = np.sqrt(weights)[:, None]
        found: Float64[np.ndarray, "k c"] = np.linalg.lstsq(root * design, root * values, rcond=None)[0]
        away = np.linalg.norm(values - design @ found, axis=1)
        weights = 1 / (1 + (away / STRAY_M) ** 2)
    return found
