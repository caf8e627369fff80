"""Tables of docs/experiments.md from the results of ``mrgs compare``, with paired differences.

    python -m benchmarks.experiments runs/judged --name judged --baseline 3dgs-rgbt

keeps what the table needs as ``benchmarks/results/compare/NAME.json`` and prints the table; without
a folder it prints the table of the results that were kept. A test holds the page to them.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import geometric_mean, mean, stdev
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
FEWEST = 3
"""With fewer scenes there is no interval."""

ERROR_RATIO = "truth.ratio_after_a_constant"
"""See ``error_ratio``; ``mrgs compare`` has the ratio without a constant."""


class Column(NamedTuple):
    """A figure of a table: its name in the results, its heading, decimals, and unit; and whether it
    is compared as a ratio, by geometric means."""

    figure: str
    heading: str
    decimals: int
    unit: str
    is_ratio: bool = False


COLUMNS = {
    "cameras": (
        Column("thermal.psnr_matched", "thermal, matched", 2, "dB"),
        Column("rgb.psnr_matched", "RGB, matched", 2, "dB"),
        Column(ERROR_RATIO, "error, camera = 1", 2, ""),
        Column("truth.depth_percent", "depth error", 2, "%"),
    ),
    "paper": (
        Column("gaussians_k", "Gaussians", 0, "K", is_ratio=True),
        Column("thermal.psnr", "thermal", 2, "dB"),
        Column("thermal.ssim", "SSIM", 3, ""),
        Column("rgb.psnr", "RGB", 2, "dB"),
        Column("rgb.ssim", "SSIM", 3, ""),
        Column("poses.aligned.thermal.psnr", "thermal, aligned", 2, "dB"),
        Column("poses.aligned.rgb.psnr", "RGB, aligned", 2, "dB"),
        Column("truth.depth_percent", "depth error", 1, "%"),
    ),
}
"""The columns of tables, by the names of their kinds."""

Kept = Mapping[str, Any]
"""What ``keep`` returns: ``command``, ``commit``, the ``baseline`` that others are compared with,
``columns`` as a name of ``COLUMNS``, and ``runs``: scene, method, seed and figures of each."""


def keep(
    folders: Sequence[Path], command: str, commit: str, baseline: str, columns: str = "cameras"
) -> Kept:
    """The figures of some comparisons' runs that a table shows, and what it is of."""
    every = [
        (folder, run)
        for folder in folders
        for run in json.loads((folder / "results.json").read_text(encoding="utf-8"))["runs"]
    ]
    named = [(run["scene"], run["method"], run["seed"]) for _, run in every]
    if len(set(named)) < len(named):
        raise SystemExit("two of the folders have runs of one scene, method and seed")
    runs = [
        {
            "scene": run["scene"],
            "method": run["method"],
            "seed": run["seed"],
            "figures": {
                column.figure: _rounded(value)
                for column in COLUMNS[columns]
                if (value := _figure(folder, run, column.figure)) is not None
            },
        }
        for folder, run in every
        if run["failure"] is None
    ]
    facts = {"command": command, "commit": commit, "baseline": baseline, "columns": columns}
    return {**facts, "runs": runs}


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
    """The table in Markdown: of each method that all scenes have, the mean over the scenes ±
    standard deviation over the seeds; of every method, the mean of its differences to the baseline,
    paired by scene, with its interval, or with fewer than three scenes the difference of each."""
    runs, baseline = kept["runs"], kept["baseline"]
    methods = sorted({run["method"] for run in runs}, key=[run["method"] for run in runs].index)
    scenes = sorted({run["scene"] for run in runs})
    trained = {(run["scene"], run["method"]) for run in runs}
    columns = COLUMNS[kept["columns"]]
    heads = [column.heading for column in columns]
    lines = [
        "| | " + " | ".join(f"{head} | to `{baseline}`" for head in heads) + " |",
        "|---" * (1 + 2 * len(heads)) + "|",
    ]
    for method in methods:
        both = method, baseline
        own = [scene for scene in scenes if all((scene, each) in trained for each in both)]
        cells = [f"`{method}`" + (f", {len(own)} of them" if len(own) < len(scenes) else "")]
        for column in columns:
            found, compared = (
                [_of_scene(runs, scene, each, column.figure) for scene in own] for each in both
            )
            if not found or not all(found + compared):
                cells += ["–", "" if method == baseline else "–"]
                continue
            cells.append(_mean_text(found, column) if len(own) == len(scenes) else "–")
            cells.append("" if method == baseline else _compared(found, compared, column))
        lines.append("| " + " | ".join(cells) + " |")
    counts = Counter((run["scene"], run["method"]) for run in runs).values()
    seeds = " to ".join(map(str, sorted({min(counts), max(counts)})))
    count = f"n = {len(scenes)} scene{'s' if len(scenes) > 1 else ''}"
    lines += ["", f"{count}, trainings of each: {seeds}; commit {kept['commit']}."]
    return "\n".join(lines) + "\n"


def _compared(
    found: Sequence[Sequence[float]], others: Sequence[Sequence[float]], column: Column
) -> str:
    """How a method's scenes differ from another's: the mean and its interval, or each of them."""
    means = [(mean(a), mean(b)) for a, b in zip(found, others, strict=True)]
    if not column.is_ratio:
        return difference_text([a - b for a, b in means], column.decimals)
    if len(means) < FEWEST:
        return ", ".join(f"{100 * a / b:.0f}" for a, b in means) + " %"
    middle, half = interval([math.log(a / b) for a, b in means])
    low, high = (100 * math.exp(middle + sign * half) for sign in (-1, 1))
    shown = "" if abs(middle) > half else ", not shown"
    return f"{100 * math.exp(middle):.0f} % ({low:.0f} to {high:.0f}{shown})"


def difference_text(differences: Sequence[float], decimals: int) -> str:
    """The mean difference and its interval, and in words whether that holds zero; of fewer than
    three, each."""
    if len(differences) < FEWEST:
        return ", ".join(f"{each:+.{decimals}f}" for each in differences).replace("-", "−")
    middle, half = interval(differences)
    text = f"{middle:+.{decimals}f} ± {half:.{decimals}f}".replace("-", "−")
    return f"{text} (not shown)" if abs(middle) <= half else text


def _mean_text(found: Sequence[Sequence[float]], column: Column) -> str:
    """The mean over the scenes, a geometric one of ratios, ± standard deviation over the seeds that
    all of them have."""
    average = geometric_mean if column.is_ratio else mean
    means = [average(of_seed) for of_seed in zip(*found, strict=False)]  # a seed may have failed
    spread = f" ± {stdev(means):.{column.decimals}f}" if len(means) > 1 else ""
    middle = average([mean(of_scene) for of_scene in found])
    return f"{middle:.{column.decimals}f}{spread} {column.unit}".rstrip()


def _of_scene(
    runs: Sequence[Mapping[str, Any]], scene: str, method: str, figure: str
) -> list[float]:
    """A figure of each seed that has it, in their order."""
    chosen = [run for run in runs if (run["scene"], run["method"]) == (scene, method)]
    chosen = sorted(chosen, key=lambda run: run["seed"])
    return [run["figures"][figure] for run in chosen if figure in run["figures"]]


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def main() -> None:
    """Keep the results of a comparison, if one is given, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.experiments")
    parser.add_argument("folders", type=Path, nargs="*", help="that mrgs compare wrote")
    parser.add_argument("--columns", choices=tuple(COLUMNS), default="cameras")
    parser.add_argument("--name", required=True, help="of the results that are kept")
    parser.add_argument("--baseline", default="3dgs-rgbt")
    parser.add_argument("--command", default="", help="that made the comparison")
    parser.add_argument("--commit", default="", help="with which its runs were trained")
    options = parser.parse_args()
    path = RESULTS / f"{options.name}.json"
    if options.folders:
        RESULTS.mkdir(parents=True, exist_ok=True)
        facts = options.command, options.commit, options.baseline, options.columns
        kept = keep(options.folders, *facts)
        path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    print(table(json.loads(path.read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()
