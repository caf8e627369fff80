"""Saddle points that lie like the inner corners of a chessboard."""

from __future__ import annotations

from collections import deque

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from mrgs.prepare.rig.target.saddles import Saddles

_NEAREST = 16
_DEVIATION_RAD = np.radians(20)
_TURN_RAD = np.radians(25)
_NO = -1

Cell = tuple[int, int]


def lattices(saddles: Saddles) -> list[dict[Cell, int]]:
    """Groups of saddle points that are neighbours of each other along their edges, the largest
    first.

    Each is given by the saddle point of each cell (column, row); columns count along the edges'
    first direction, rows along the second, clockwise from it in the image.
    """
    links, turns = _links(saddles)
    left = set(np.flatnonzero((links != _NO).sum(axis=1) >= 2).tolist())
    found = []
    while left:
        group = _connected(min(left), links, turns)
        left -= set(group.values())
        found.append(group)
    return sorted(found, key=len, reverse=True)


def _links(saddles: Saddles) -> tuple[Int[np.ndarray, "n 4"], Int[np.ndarray, "n 4"]]:
    """For each saddle point and edge: the neighbour at its other end, and by how many quarters the
    neighbour's edges are numbered differently. -1 where there is none.

    A neighbour is the nearest point along the edge whose own edges run alike and whose bright and
    dark quarters are swapped, provided that the relation is mutual.
    """
    count = len(saddles.pixels)
    none = np.full((count, 4), _NO)
    if count < 2:
        return none, none
    _, near = cKDTree(saddles.pixels).query(saddles.pixels, k=min(_NEAREST + 1, count))
    near = near[:, 1:]
    offset = saddles.pixels[near] - saddles.pixels[:, None]
    bearing = np.arctan2(offset[..., 1], offset[..., 0])
    deviation = np.abs(_wrapped(bearing[:, None] - saddles.angles[:, :, None]))
    turn, alike = _quarters(saddles.angles, saddles.angles[near])
    other = saddles.bright[near] ^ (turn % 2 == 1) ^ saddles.bright[:, None]
    fits = (deviation < _DEVIATION_RAD) & (alike & other)[:, None]
    first = fits.argmax(axis=2)
    links = np.where(fits.any(axis=2), np.take_along_axis(near, first, axis=1), _NO)
    turns = np.take_along_axis(turn, first, axis=1)
    edge = np.arange(4)
    back = links[links, (edge + 2 + turns) % 4]
    mutual = (links != _NO) & (back == np.arange(count)[:, None])
    return np.where(mutual, links, _NO), turns


def _quarters(
    own: Float[np.ndarray, "n 4"], others: Float[np.ndarray, "n k 4"]
) -> tuple[np.ndarray, np.ndarray]:
    """By how many quarters the others' edges are numbered differently [n, k], and whether both
    edges run alike."""
    first = np.abs(_wrapped(others - own[:, None, :1]))
    turn = first.argmin(axis=2)
    second = np.take_along_axis(others, (turn[..., None] + 1) % 4, axis=2)[..., 0]
    alike = (first.min(axis=2) < _TURN_RAD) & (
        np.abs(_wrapped(second - own[:, None, 1])) < _TURN_RAD
    )
    return turn, alike


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))


def _connected(
    seed: int, links: Int[np.ndarray, "n 4"], turns: Int[np.ndarray, "n 4"]
) -> dict[Cell, int]:
    """The saddle points linked to a seed, by cell; each cell has one."""
    cells: dict[Cell, int] = {(0, 0): seed}
    found: dict[int, tuple[Cell, int]] = {seed: ((0, 0), 0)}
    queue = deque([seed])
    while queue:
        point = queue.popleft()
        (column, row), turned = found[point]
        for edge in range(4):
            neighbour = int(links[point, edge])
            if neighbour == _NO or neighbour in found:
                continue
            right, down = _STEPS[(edge - turned) % 4]
            cell = (column + right, row + down)
            if cell in cells:
                continue
            cells[cell] = neighbour
            found[neighbour] = (cell, (turned + int(turns[point, edge])) % 4)
            queue.append(neighbour)
    return cells
