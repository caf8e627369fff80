"""The rows of a solar plant: where its modules stand, how warm their cells are, which are
defective."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from mrgs_synth.solar_plant.ground import Ground

MODULE_M = (1.05, 1.75)
"""Width and height of a module, mounted upright."""

FRAME_M = 0.03
CELLS = (6, 10)
"""Cells of a module across and along."""

TABLE_MODULES = (6, 2)
"""Modules of a table along the row, at most, and above each other."""

TABLE_GAP_M = 0.25
PITCH_M = 6.0
"""From row to row."""

TILT_DEG = 20.0
CLEARANCE_M = 0.8
"""Of the lower edge above the ground."""

SOUND_C = 46.0
AIR_C = 24.0
"""Temperature of a sound module in the sun, and of the air."""

Kind = Literal["cell", "substring", "module"]
DEFECTS: dict[Kind, tuple[float, tuple[float, float]]] = {
    "cell": (0.06, (5.0, 35.0)),
    "substring": (0.02, (3.0, 8.0)),
    "module": (0.015, (2.5, 6.0)),
}
"""Share of the modules that have one, and by how many °C its cells are hotter: a cell, a third of a
module behind one bypass diode, a module in open circuit."""

FEWEST = 2
"""Of each kind."""


@dataclass(frozen=True)
class Defect:
    """Hot cells.

    Attributes:
        kind: a cell, a substring or a module.
        row: of the plant, from 0 in the south.
        table: in the row, from 0 in the west.
        module: in the table, column and row from its lower left corner.
        position_m: the middle of the hot cells, world coordinates.
        size_m: of the hot rectangle, along the row and up the slope.
        delta_c: by how much it is hotter than the sound cells of its table.
        cells: of its table that are hot: first column and row, numbers of columns and rows.
    """

    kind: Kind
    row: int
    table: int
    module: tuple[int, int]
    position_m: tuple[float, float, float]
    size_m: tuple[float, float]
    delta_c: float
    cells: tuple[int, int, int, int]

    def to_json(self) -> dict[str, Any]:
        """Its attributes, lengths to a millimetre."""
        return asdict(self) | {
            "position_m": [round(x, 3) for x in self.position_m],
            "size_m": [round(x, 3) for x in self.size_m],
            "delta_c": round(self.delta_c, 3),
        }


@dataclass(frozen=True, eq=False)
class Tables:
    """The T tables of a plant, each a plane rectangle.

    Attributes:
        corner: lower left corner, world coordinates, [T, 3].
        along: unit vector along the row, [T, 3].
        up: unit vector up the slope, [T, 3].
        modules: along the row, [T].
        row: of the plant, [T].
        tone: brightness of each module, about 1, [T, 2, 6].
        cell_c: temperature of each cell, °C, from the lower left corner, [T, 20, 36].
    """

    corner: Float[np.ndarray, "t 3"]
    along: Float[np.ndarray, "t 3"]
    up: Float[np.ndarray, "t 3"]
    modules: Int[np.ndarray, " t"]
    row: Int[np.ndarray, " t"]
    tone: Float[np.ndarray, "t 2 6"]
    cell_c: Float[np.ndarray, "t 20 36"]


@dataclass(frozen=True, eq=False)
class Plant:
    """A solar plant: ground, tables and their defects.

    Attributes:
        ground: below it.
        tables: of modules.
        defects: that the tables show.
        low: smallest x and y of the tables, metres.
        high: largest x and y, metres.
    """

    ground: Ground
    tables: Tables
    defects: tuple[Defect, ...]
    low: tuple[float, float]
    high: tuple[float, float]


def drawn_plant(rows: int, modules: int, border_m: float, rng: np.random.Generator) -> Plant:
    """A plant whose middle is the origin.

    Args:
        rows: of tables, one behind the other to the north.
        modules: along each row; two stand above each other.
        border_m: ground about the tables.
        rng: of everything that varies.
    """
    counts = [
        min(TABLE_MODULES[0], modules - first) for first in range(0, modules, TABLE_MODULES[0])
    ]
    width = modules * MODULE_M[0] + (len(counts) - 1) * TABLE_GAP_M
    slope_m = TABLE_MODULES[1] * MODULE_M[1] * np.cos(np.radians(TILT_DEG))
    depth = (rows - 1) * PITCH_M + slope_m
    high = width / 2, float(depth) / 2
    low = -high[0], -high[1]
    ground = Ground.drawn(
        (low[0] - border_m, low[1] - border_m), (high[0] + border_m, high[1] + border_m), rng
    )
    tables = _tables(ground, rows, counts, low, rng)
    defects = drawn_defects(tables, rng)
    return Plant(ground, tables, defects, low, high)


def _tables(
    ground: Ground,
    rows: int,
    counts: list[int],
    low: tuple[float, float],
    rng: np.random.Generator,
) -> Tables:
    """Tables that follow the ground along their row."""
    widths = np.tile(counts, rows) * MODULE_M[0]
    row = np.repeat(np.arange(rows), len(counts))
    starts = np.concatenate([[0.0], np.cumsum(np.array(counts) * MODULE_M[0] + TABLE_GAP_M)[:-1]])
    west = low[0] + np.tile(starts, rows)
    south = low[1] + row * PITCH_M
    middle = south + MODULE_M[1] * TABLE_MODULES[1] / 2 * np.cos(np.radians(TILT_DEG))
    left, right = (ground.height_at(x, middle) for x in (west, west + widths))
    along = np.stack([widths, np.zeros_like(widths), right - left], axis=1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    tilt = np.radians(TILT_DEG + rng.normal(0.0, 0.5, len(row)))
    up = np.stack([np.zeros_like(tilt), np.cos(tilt), np.sin(tilt)], axis=1)
    up -= (up * along).sum(axis=1, keepdims=True) * along
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    corner = np.stack([west, south, left + CLEARANCE_M], axis=1)
    across, above = TABLE_MODULES
    shape = len(row), above, across
    module_c = SOUND_C + rng.normal(0.0, 0.3, shape)
    cells = np.repeat(np.repeat(module_c, CELLS[1], axis=1), CELLS[0], axis=2)
    cells = cells + rng.normal(0.0, 0.12, cells.shape)
    cells += (
        rng.uniform(-0.03, 0.03) * corner[:, :1, None]
        + rng.uniform(-0.03, 0.03) * corner[:, 1:2, None]
    )
    tone = rng.normal(1.0, 0.12, shape).clip(0.6, 1.4)
    return Tables(corner, along, up, np.tile(counts, rows), row, tone, cells)


def heat(tables: Tables, defect: Defect, kelvin: float) -> None:
    """Warm a defect's cells."""
    table = np.flatnonzero(tables.row == defect.row)[defect.table]
    column, row, across, along = defect.cells
    tables.cell_c[table, row : row + along, column : column + across] += kelvin


def drawn_defects(
    tables: Tables, rng: np.random.Generator, others: Collection[Defect] = ()
) -> tuple[Defect, ...]:
    """Heat the cells of modules drawn at random, no module twice, and none of the others'."""
    taken = {(each.row, each.table, each.module) for each in others}
    all_modules = [
        (table, column, above)
        for table, count in enumerate(tables.modules)
        for column in range(count)
        for above in range(TABLE_MODULES[1])
        if (int(tables.row[table]), _in_row(tables, table), (column, above)) not in taken
    ]
    order = iter(rng.permutation(len(all_modules)))
    found = []
    for kind, (share, (least, most)) in DEFECTS.items():
        for _ in range(max(FEWEST, round(share * len(all_modules)))):
            if (chosen := next(order, None)) is None:
                break
            delta = float(np.exp(rng.uniform(np.log(least), np.log(most))))
            found.append(_heated(tables, kind, all_modules[chosen], delta, rng))
    return tuple(found)


def _in_row(tables: Tables, table: int) -> int:
    return table - int(np.argmax(tables.row == tables.row[table]))


def _heated(
    tables: Tables,
    kind: Kind,
    module: tuple[int, int, int],
    delta_c: float,
    rng: np.random.Generator,
) -> Defect:
    table, column, above = module
    across, along = {"cell": (1, 1), "substring": (CELLS[0] // 3, CELLS[1]), "module": CELLS}[kind]
    first = (
        int(rng.integers(CELLS[0] // across)) * across,
        int(rng.integers(CELLS[1] // along)) * along,
    )
    left, bottom = column * CELLS[0] + first[0], above * CELLS[1] + first[1]
    side = cell_side_m()
    u = column * MODULE_M[0] + FRAME_M + (first[0] + across / 2) * side[0]
    v = above * MODULE_M[1] + FRAME_M + (first[1] + along / 2) * side[1]
    place = tables.corner[table] + u * tables.along[table] + v * tables.up[table]
    defect = Defect(
        kind, int(tables.row[table]), _in_row(tables, table), (column, above),
        (float(place[0]), float(place[1]), float(place[2])),
        (across * side[0], along * side[1]), delta_c, (left, bottom, across, along),
    )  # fmt: skip
    heat(tables, defect, delta_c)
    return defect


def cell_side_m() -> tuple[float, float]:
    """Width and height of a cell."""
    return (
        (MODULE_M[0] - 2 * FRAME_M) / CELLS[0],
        (MODULE_M[1] - 2 * FRAME_M) / CELLS[1],
    )
