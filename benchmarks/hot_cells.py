"""How well `mrgs modules` lists a solar plant: `python -m benchmarks.hot_cells RUN...`

Lists the modules of each run, and compares places, kinds and ΔT with the plant that ``mrgs synth
--scene solar-plant`` made: its layout, and ``truth/defects.json``. Prints a table.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mrgs.report.modules import ModuleTable, module_table
from mrgs.runs.open import load_run
from mrgs_synth.solar_plant import PlantOptions
from mrgs_synth.solar_plant.layout import MODULE_M, TABLE_MODULES, Plant

Numbers = tuple[int, int, int]
FAR = 0.5
"""A module is in a wrong place if its middle is so many of its shorter sides away."""

KINDS = {"cell": "hot cell", "substring": "hot third", "module": "hot module"}


class Errors(NamedTuple):
    """What is wrong with a table: modules that are missing, that are none, and in a wrong place;
    distances of the others' middles, m; findings at sound modules; and for each kind of defect its
    ΔT, the error of it, and the ± (K; NaN where another kind or nothing was found)."""

    modules: int
    lost: int
    invented: int
    misplaced: int
    away_m: np.ndarray
    false: int
    kinds: Mapping[str, np.ndarray]


def plant_of(scene: Path) -> tuple[Plant, list[dict[str, Any]]]:
    """The plant that a generated scene shows, and its defects."""
    facts = json.loads((scene / "truth/synth.json").read_text(encoding="utf-8"))
    chosen = {each.name: facts[each.name] for each in fields(PlantOptions)}
    plant = PlantOptions(**chosen).plant()
    defects = json.loads((scene / "truth/defects.json").read_text(encoding="utf-8"))["defects"]
    return plant, defects


def true_modules(plant: Plant) -> dict[Numbers, tuple[tuple[int, int, int], np.ndarray]]:
    """Table, column and row in it, and middle of each module by its numbers."""
    tables, found = plant.tables, {}
    rows = int(tables.row.max()) + 1
    for table, (row, count) in enumerate(zip(tables.row, tables.modules, strict=True)):
        before = int(tables.modules[:table][tables.row[:table] == row].sum())
        for column in range(count):
            for above in range(TABLE_MODULES[1]):
                u, v = (column + 0.5) * MODULE_M[0], (above + 0.5) * MODULE_M[1]
                middle = tables.corner[table] + u * tables.along[table] + v * tables.up[table]
                numbers = rows - int(row), TABLE_MODULES[1] - above, before + column + 1
                found[numbers] = (table, column, above), middle
    return found


def errors_of(table: ModuleTable, plant: Plant, defects: list[dict[str, Any]]) -> Errors:
    """Compare a table with the truth."""
    true = true_modules(plant)
    rows = {(row["row"], row["line"], row["place"]): row for row in table.rows}
    places = dict(zip(rows, table.corners.mean(axis=1), strict=True))
    both = sorted(true.keys() & rows.keys())
    away = np.array([np.linalg.norm((places[each] - true[each][1])[:2]) for each in both])
    by_table = {table: numbers for numbers, (table, _) in true.items()}
    first = {row: int(np.argmax(plant.tables.row == row)) for row in set(plant.tables.row.tolist())}
    defect_of, kinds = {}, {kind: [] for kind in KINDS}
    for defect in defects:
        numbers = by_table[(first[defect["row"]] + defect["table"], *defect["module"])]
        defect_of[numbers] = defect
        row, delta = rows.get(numbers, {"finding": ""}), defect["delta_c"]
        found = KINDS[defect["kind"]] in row["finding"]
        error = (row["delta_k"] - delta, row["uncertainty_k"]) if found else (np.nan, np.nan)
        kinds[defect["kind"]].append((delta, *error))
    return Errors(
        len(true), len(true.keys() - rows.keys()), len(rows.keys() - true.keys()),
        int((away > FAR * min(MODULE_M)).sum()), away,
        sum(bool(rows[each]["finding"]) for each in both if each not in defect_of),
        {kind: np.array(each) for kind, each in kinds.items()},
    )  # fmt: skip


def report(path: Path) -> None:
    """Print a run's table."""
    started = time.process_time()
    run = load_run(path)
    table = module_table(run, MODULE_M, scene=run.load_scene())
    seconds = time.process_time() - started
    found = errors_of(table, *plant_of(Path(table.scene.path)))
    print(
        f"\n{path}: {found.modules} modules, {found.lost} missing, {found.invented} invented, "
        f"{found.misplaced} misplaced; middles off by {100 * np.median(found.away_m):.1f} cm, at "
        f"most {100 * found.away_m.max():.1f}; {found.false} findings at sound modules; "
        f"{100 * table.pixel:.1f} cm per pixel; {seconds:.0f} processor s, "
        f"{len(table.scene.train)} photos used\n"
    )
    print("| | found | error of ΔT, median | mean size | within 2 K | within ± (median ±) |")
    print("|---|---|---|---|---|---|")
    for kind, each in found.kinds.items():
        error, around = each[np.isfinite(each[:, 1]), 1:].T
        size, within = np.abs(error), np.abs(error) <= around
        print(
            f"| {kind} | {len(error)} of {len(each)} | {np.median(error):+.2f} K "
            f"| {size.mean():.2f} K | {(size <= 2).sum()} "
            f"| {within.sum()} ({np.median(around):.1f}) |"
        )


def main() -> None:
    """The command line."""
    for name in sys.argv[1:]:
        report(Path(name))


if __name__ == "__main__":
    main()
