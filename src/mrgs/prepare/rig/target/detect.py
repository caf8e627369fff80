"""A chessboard in a photo or in a thermal image: the inner corners, where four squares meet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, zoom

from mrgs.data.undistort import sampled
from mrgs.prepare.rig.target.lattice import Cell, lattices
from mrgs.prepare.rig.target.plane import board_points, homography, transformed
from mrgs.prepare.rig.target.saddles import Saddles, find_saddles, refined

_LARGEST_PX = 1280
_SMALLEST_PX = 100
_SIGMAS_PX = (1.5, 2.5)
_LEAST_FILLED = 0.6
_FIT_SQUARES = 0.3
_QUARTER_SQUARES = 0.35
_IRREGULAR_SQUARES = 0.15


@dataclass(frozen=True, eq=False)
class Corners:
    """The inner corners of a chessboard in an image.

    Attributes:
        grid: positions x, y in pixels, [rows, columns, 2]. The direction along a row turns
            clockwise into that along a column: the board is seen from its front. The image does
            not show which of the board's corners is the first: see ``orderings``.
    """

    grid: Float[np.ndarray, "rows columns 2"]

    @property
    def pixels(self) -> Float[np.ndarray, "n 2"]:
        """Positions x, y in pixels, row by row."""
        return self.grid.reshape(-1, 2)

    @property
    def spacing(self) -> Float[np.ndarray, "rows columns"]:
        """The distance of each corner from the nearest of its neighbours, in pixels."""
        spacing = np.full(self.grid.shape[:2], np.inf)
        for axis in (0, 1):
            length = np.linalg.norm(np.diff(self.grid, axis=axis), axis=2)
            for side in ((1, 0), (0, 1)):
                pad = [side if other == axis else (0, 0) for other in (0, 1)]
                spacing = np.minimum(spacing, np.pad(length, pad, constant_values=np.inf))
        return spacing

    def orderings(self) -> list[Corners]:
        """The same corners in each order that looks the same: two, or four if there are as many
        rows as columns."""
        rows, columns, _ = self.grid.shape
        return [
            Corners(np.rot90(self.grid, quarters))
            for quarters in range(0, 4, 1 if rows == columns else 2)
        ]


def detect_chessboard(image: Float[np.ndarray, "h w"], inner: tuple[int, int]) -> Corners | None:
    """Find a chessboard of which all inner corners are in the image; None if there is none.

    Saddle points are found at several scales, linked to a grid along their edges, and placed to a
    fraction of a pixel. At each corner the four squares around must alternate. Which squares are
    the bright ones does not matter.

    Args:
        image: any unit; with or without lens distortion.
        inner: how many inner corners there are in a row and in a column, both 3 or more.
    """
    image = (image - np.median(image)).astype(np.float32)
    for saddles in _at_scales(image):
        for group in lattices(saddles):
            if len(group) < _LEAST_FILLED * inner[0] * inner[1]:
                break
            for cells in _candidates(group, inner):
                corners = _fitted(image, saddles, cells, inner)
                if corners is not None:
                    return corners
    return None


def _at_scales(image: Float[np.ndarray, "h w"]) -> Iterator[Saddles]:
    """Saddle points of the image, from coarse to fine; positions in pixels of the image."""
    longest = max(image.shape)
    reductions = [1 << level for level in range(16) if longest >> level >= _SMALLEST_PX]
    for reduction in reversed(
        [r for r in reductions if longest <= r * _LARGEST_PX] or reductions[-1:]
    ):
        small = image
        if reduction > 1:
            small = zoom(
                gaussian_filter(image, reduction / 2),
                1 / reduction,
                order=1,
                grid_mode=True,
                mode="nearest",
            )
        scale = np.array(image.shape[::-1]) / small.shape[::-1]
        for sigma_px in _SIGMAS_PX:
            found = find_saddles(small, sigma_px)
            yield Saddles(found.pixels * scale, found.angles, found.bright)


def _candidates(group: dict[Cell, int], inner: tuple[int, int]) -> Iterator[dict[Cell, int]]:
    """Parts of a lattice that are as large as the board, those with the most saddle points first;
    columns along the board's rows. Cells are counted from the part's first."""
    cells = np.array(list(group))
    points = np.array(list(group.values()))
    found = []
    for transposed in (False, True):
        if transposed:
            cells = np.column_stack([cells[:, 1], -cells[:, 0]])
            if inner[0] == inner[1]:
                break
        for right in range(cells[:, 0].min() - 1, cells[:, 0].max() - inner[0] + 3):
            for down in range(cells[:, 1].min() - 1, cells[:, 1].max() - inner[1] + 3):
                own = cells - (right, down)
                inside = ((own >= 0) & (own < inner)).all(axis=1)
                if inside.sum() >= _LEAST_FILLED * inner[0] * inner[1]:
                    found.append(
                        {
                            (int(c), int(r)): int(p)
                            for (c, r), p in zip(own[inside], points[inside], strict=True)
                        }
                    )
    yield from sorted(found, key=len, reverse=True)


def _fitted(
    image: Float[np.ndarray, "h w"],
    saddles: Saddles,
    cells: dict[Cell, int],
    inner: tuple[int, int],
) -> Corners | None:
    """The board's corners from those in ``cells``; None if it is not there."""
    columns, rows = inner
    known = np.array(list(cells), dtype=float)
    pixels = transformed(
        homography(known, saddles.pixels[list(cells.values())]), board_points(*inner)
    )
    for (column, row), point in cells.items():
        pixels[row * columns + column] = saddles.pixels[point]
    grid = pixels.reshape(rows, columns, 2)
    grid = refined(image, pixels, _FIT_SQUARES * Corners(grid).spacing.ravel()).reshape(
        rows, columns, 2
    )
    corners = Corners(grid)
    return corners if _is_board(image, corners) and not _extends(image, corners) else None


def _is_board(image: Float[np.ndarray, "h w"], corners: Corners) -> bool:
    return (
        bool(np.isfinite(corners.grid).all()) and _regular(corners) and _alternating(image, corners)
    )


def _extends(image: Float[np.ndarray, "h w"], corners: Corners) -> bool:
    """Whether there is one more row or column: then this is part of a larger board, and any other
    part would fit as well."""
    for quarters in range(4):
        grid = np.rot90(corners.grid, quarters)
        beyond = 2 * grid[:1] - grid[1:2]
        radius_px = _FIT_SQUARES * np.linalg.norm(grid[0] - grid[1], axis=1)
        beyond = refined(image, beyond[0], radius_px)[None]
        if _is_board(image, Corners(np.concatenate([beyond, grid[:-1]]))):
            return True
    return False


def _regular(corners: Corners) -> bool:
    """Whether each corner lies nearly in the middle between its neighbours."""
    bends = [np.linalg.norm(np.diff(corners.grid, n=2, axis=axis), axis=2) / 2 for axis in (0, 1)]
    limit = _IRREGULAR_SQUARES * corners.spacing
    return bool((bends[0] < limit[1:-1]).all() and (bends[1] < limit[:, 1:-1]).all())


def _alternating(image: Float[np.ndarray, "h w"], corners: Corners) -> bool:
    """Whether at each corner the two squares of one diagonal are brighter than both of the other,
    by turns."""
    grid = corners.grid
    along, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    smooth = gaussian_filter(image, _QUARTER_SQUARES / 3 * float(corners.spacing.min()))
    a, b, c, d = (
        sampled(smooth, *np.moveaxis(grid + _QUARTER_SQUARES * (i * along + j * down), -1, 0))
        for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    )
    brighter = np.minimum(a, c) > np.maximum(b, d)
    darker = np.maximum(a, c) < np.minimum(b, d)
    even = np.indices(brighter.shape).sum(axis=0) % 2 == 0
    return bool((np.where(even, brighter, darker)).all() or np.where(even, darker, brighter).all())
