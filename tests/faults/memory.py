"""The memory that a training says it will need, and what it takes."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from mrgs.data import load_scene
from mrgs.runs.open import load_run
from mrgs.training import estimate_bytes
from tests.faults.program import run, small_scene
from tests.faults.tally import Tally

WITHIN = 0.2
BUNDLED = Path(__file__).parents[2] / "examples" / "tabletop"
METHODS = ("3dgs-rgbt", "mrgs", "mrgs-plus")


def estimates(folder: Path, methods: Sequence[str] = METHODS, steps: int = 60) -> Tally:
    """Trainings on a small scene and on the bundled one, with the kernels of an earlier process."""
    tally, worst = Tally(), 0.0
    for path in (small_scene(folder / "scene"), BUNDLED):
        for method in methods:
            output = folder / f"{path.name}_{method}"
            options = ("--method", method, "--preset", "fast", "--max-steps", steps)
            for place in ("compiles", "measured"):
                found = run("train", path, "--output", output / place, *options)
            if found.status != 0:
                tally.judge(f"{method} on {path.name}", False, found)
                continue
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                opened, scene = load_run(output / "measured"), load_scene(path)
            said = estimate_bytes(scene, opened.config, opened.gaussian_count)
            off = said / opened.facts.peak_memory_bytes - 1
            worst = max(worst, off, key=abs)
            tally.judge(f"{method} on {path.name}", abs(off) <= WITHIN, f"off by {off:+.0%}")
    tally.figure = f"worst {worst:+.0%}"
    return tally
