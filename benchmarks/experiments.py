"""Tables of docs/experiments.md from the results of ``mrgs compare``, with paired differences.

    python -m benchmarks.experiments runs/judged --name judged --baseline 3dgs-rgbt

keeps what the table needs as ``benchmarks/results/compare/NAME.json`` and prints the table; without
a folder it prints the table of the results that were kept. A test holds the page to them.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student_t

from mrgs import open_run
from mrgs.evaluation.evaluate import Truth
from mrgs.evaluation.metrics import Missing
from mrgs.runs.trained_run import TrainedRun
from mrgs.scene import THERMAL

RESULTS = Path(__file__).parent / "results" / "compare"
LEVEL = 0.95

ERROR_RATIO = "truth.ratio_after_a_constant"
"""See ``error_ratio``; ``mrgs compare`` has the ratio without a constant."""


class Column(NamedTuple):
    """A figure of a table: its name in the results, its heading, decimals, and unit."""

    figure: str
    heading: str
    decimals: int
    unit: str


COLUMNS = (
    Column("thermal.psnr_matched", "thermal, matched", 2, "dB"),
    Column("rgb.psnr_matched", "RGB, matched", 2, "dB"),
    Column(ERROR_RATIO, "error, camera = 1", 2, ""),
    Column("truth.depth_percent", "depth error", 2, "%"),
)

Kept = Mapping[str, Any]
"""What ``keep`` returns: ``command``, ``commit``, the ``baseline`` that others are compared with,
and ``runs``, each with its scene, method, seed and figures."""


def keep(folder: Path, command: str, commit: str, baseline: str) -> Kept:
    """The figures of a comparison's runs that a table shows, and what it is of."""
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    runs = [
        {
            "scene": run["scene"],
            "method": run["method"],
            "seed": run["seed"],
            "figures": {
                column.figure: _rounded(value)
                for column in COLUMNS
                if (value := _figure(folder, run, column.figure)) is not None
            },
        }
        for run in results["runs"]
        if run["failure"] is None
    ]
    return {"command": command, "commit": commit, "baseline": baseline, "runs": runs}


def _figure(folder: Path, run: Mapping[str, Any], figure: str) -> float | None:
    if figure != ERROR_RATIO:
        value: float | None = run["figures"].get(figure)
        return value
    return error_ratio(
        open_run(folder / "runs" / run["scene"] / run["method"] / f"seed_{run['seed']}")
    )


def error_ratio(run: TrainedRun) -> float | None:
    """Mean absolute error of the held-out views over that of the camera's own images of them, each
    after one constant for all views, because a drifting camera leaves one unknown; None without
    exact temperatures."""
    scene = run.load_scene()
    truth, scale = Truth.of(scene), scene.temperature
    if truth is None or scale is None:
        return None
    own: list[np.ndarray] = []
    of_camera: list[np.ndarray] = []
    for view in scene.eval:
        photo = view.images[THERMAL].load()
        height, width, _ = photo.values.shape
        exact = truth.read("temperature", view.name, (height, width))
        if isinstance(exact, Missing):
            return None
        known = exact.isfinite() if photo.valid is None else exact.isfinite() & photo.valid
        rendered = run.render_view(view)[THERMAL].image
        for errors, shown in ((own, rendered), (of_camera, photo.values)):
            errors.append((scale.to_celsius(shown[..., 0]) - exact)[known].double().numpy())
    return _after_a_constant(own) / _after_a_constant(of_camera)


def _after_a_constant(errors: Sequence[np.ndarray]) -> float:
    together = np.concatenate([each.ravel() for each in errors])
    return float(np.abs(together - np.median(together)).mean())


def interval(differences: Sequence[float]) -> tuple[float, float]:
    """Mean of paired differences, and the half width of its interval of 95 % by Student's t."""
    count = len(differences)
    spread = stdev(differences) / math.sqrt(count)
    return mean(differences), float(student_t.ppf(0.5 + LEVEL / 2, count - 1)) * spread


def table(kept: Kept) -> str:
    """The table in Markdown: of each method the mean over the scenes ± standard deviation over the
    seeds, and the mean of its differences to the baseline, paired by scene, with their interval."""
    runs, baseline = kept["runs"], kept["baseline"]
    methods = sorted({run["method"] for run in runs}, key=[run["method"] for run in runs].index)
    scenes = sorted({run["scene"] for run in runs})
    heads = [column.heading for column in COLUMNS]
    lines = [
        "| | " + " | ".join(f"{head} | to `{baseline}`" for head in heads) + " |",
        "|---" * (1 + 2 * len(heads)) + "|",
    ]
    for method in methods:
        cells = [f"`{method}`"]
        for column in COLUMNS:
            found, compared = (
                [_of_scene(runs, scene, each, column.figure) for scene in scenes]
                for each in (method, baseline)
            )
            cells.append(_mean_text(runs, scenes, method, column))
            paired = [mean(a) - mean(b) for a, b in zip(found, compared, strict=True)]
            cells.append("" if method == baseline else difference_text(paired, column.decimals))
        lines.append("| " + " | ".join(cells) + " |")
    seeds = len({run["seed"] for run in runs})
    lines += ["", f"n = {len(scenes)} scenes, trainings of each: {seeds}; commit {kept['commit']}."]
    return "\n".join(lines) + "\n"


def difference_text(differences: Sequence[float], decimals: int) -> str:
    """The mean difference and its interval; in words where the interval holds zero."""
    middle, half = interval(differences)
    text = f"{middle:+.{decimals}f} ± {half:.{decimals}f}".replace("-", "−")
    return f"{text} (not shown)" if abs(middle) <= half else text


def _mean_text(
    runs: Sequence[Mapping[str, Any]], scenes: Sequence[str], method: str, column: Column
) -> str:
    by_seed = zip(*(_of_scene(runs, scene, method, column.figure) for scene in scenes), strict=True)
    means = [mean(of_seed) for of_seed in by_seed]
    spread = f" ± {stdev(means):.{column.decimals}f}" if len(means) > 1 else ""
    return f"{mean(means):.{column.decimals}f}{spread} {column.unit}".rstrip()


def _of_scene(
    runs: Sequence[Mapping[str, Any]], scene: str, method: str, figure: str
) -> list[float]:
    """A figure of each seed, in their order."""
    chosen = [run for run in runs if (run["scene"], run["method"]) == (scene, method)]
    return [run["figures"][figure] for run in sorted(chosen, key=lambda run: run["seed"])]


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def main() -> None:
    """Keep the results of a comparison, if one is given, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.experiments")
    parser.add_argument("folder", type=Path, nargs="?", help="that mrgs compare wrote")
    parser.add_argument("--name", required=True, help="of the results that are kept")
    parser.add_argument("--baseline", default="3dgs-rgbt")
    parser.add_argument("--command", default="", help="that made the comparison")
    parser.add_argument("--commit", default="", help="with which its runs were trained")
    options = parser.parse_args()
    path = RESULTS / f"{options.name}.json"
    if options.folder is not None:
        RESULTS.mkdir(parents=True, exist_ok=True)
        kept = keep(options.folder, options.command, options.commit, options.baseline)
        path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    print(table(json.loads(path.read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()
