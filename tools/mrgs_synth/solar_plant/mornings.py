"""A solar plant on two mornings: which modules were repaired, and which became hot, is known."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mrgs_synth.cameras import Frame
from mrgs_synth.dates import WEATHER_C, Change, ChangeKind, Patch, write_changes
from mrgs_synth.solar_plant.cast import photograph, surfaces_of
from mrgs_synth.solar_plant.generate import PlantOptions, photograph_plant
from mrgs_synth.solar_plant.layout import CELLS, Defect, Plant, drawn_defects, heat

MODULE_C = 0.3
"""Standard deviation of what the weather warms a module more than all others."""

STEP_C = (1.5, 6.0)
"""By how much a defect grows hotter or cooler."""

SHIFT_M, TURN_DEG = 0.6, 0.3
"""Standard deviations of where GPS puts the second survey."""


def synthesize_mornings(before: Path, after: Path, options: PlantOptions) -> list[Change]:
    """Generate two surveys of one plant; the second one has a flight and coordinates of its own. Of
    three defects one stays, one is repaired, and one grows hotter or cooler; as many as there were
    are new. Returns these, of which ``truth/changes.json`` and ``truth/after`` of the first scene
    tell as in ``synthesize_dates``.

    Raises:
        ConfigError: a folder holds a scene already.
    """
    rng = np.random.default_rng([options.seed, 70])
    first = options.plant()
    second, changes = _later(first, rng)
    warmer_c = float(rng.uniform(1.0, WEATHER_C) * rng.choice([-1, 1]))
    turn = Rotation.from_euler("z", rng.normal(0.0, TURN_DEG), degrees=True).as_matrix()
    frame = Frame(1.0, turn, rng.normal(0.0, SHIFT_M, 3))
    own = replace(options, seed=options.seed + 5000)
    photograph_plant(before, first, options, every_truth=True)
    photograph_plant(after, second, own, frame=frame, warmer_c=warmer_c)
    surfaces, cameras = surfaces_of(second), options.flight(first).cameras
    exact = {name: photograph(surfaces, each).exact_c + warmer_c for name, each in cameras.items()}
    write_changes(before, changes, exact, frame)
    return changes


def _later(plant: Plant, rng: np.random.Generator) -> tuple[Plant, list[Change]]:
    """The plant on the second morning, and what has changed."""
    tables = copy.deepcopy(plant.tables)
    warmer = rng.normal(0.0, MODULE_C, tables.tone.shape)
    tables.cell_c[:] += warmer.repeat(CELLS[1], axis=1).repeat(CELLS[0], axis=2)
    changes, left = [], []
    for number, place in enumerate(rng.permutation(len(plant.defects))):
        defect = plant.defects[place]
        step = float(rng.uniform(*STEP_C) * rng.choice([-1, 1]))
        now = max((defect.delta_c, 0.0, defect.delta_c + step)[number % 3], 0.0)
        heat(tables, defect, now - defect.delta_c)
        changes.append(_change(defect, defect.delta_c, now))
        left += [replace(defect, delta_c=now)] if now else []
    fresh = drawn_defects(tables, rng, plant.defects)
    changes += [_change(each, 0.0, each.delta_c) for each in fresh]
    return replace(plant, tables=tables, defects=(*left, *fresh)), changes


def _change(defect: Defect, before: float, after: float) -> Change:
    kind: ChangeKind = "warmer" if after > before else "colder"
    if before == after:
        kind = "same"
    elif not before or not after:
        kind = "new" if after else "gone"
    radius = max(defect.size_m) / 2
    patches = Patch(radius, before), Patch(radius, after)
    return Change(kind, f"row {defect.row} {defect.kind}", defect.position_m, *patches)
