"""The results as a table and a chart."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.quality.plan import Curve, Point, Variant, time_until

TITLES = {
    "thermal": "thermal PSNR, dB",
    "rgb": "RGB PSNR, dB",
    "error": "error over the camera's",
}
CLOCKS = {"cpu_s": "processor", "wall_s": "clock"}


def to_markdown(
    curves: Sequence[Curve], targets: Mapping[str, float], heading: Sequence[str]
) -> str:
    """Final scores, and the time until the first variant's own final scores, as ratios to the time
    of the first variant in the same round.

    Args:
        curves: of all trainings.
        targets: scores to reach, by name; for others, what the first variant ends with on the same
            scene with the same seed.
        heading: lines on the machine and the settings.
    """
    by_variant = _by_variant(curves)
    first = next(iter(by_variant))
    lines = ["# Time until a training is good", "", *heading, ""]
    lines += [
        "| | " + " | ".join(TITLES.values()) + " | Gaussians | processor s | s |",
        "|---|" + "---|" * (len(TITLES) + 3),
    ]
    for variant, own in by_variant.items():
        lasts = [curve.points[-1] for curve in own]
        cells = [_spread([p.scores[n] for p in lasts if n in p.scores]) for n in TITLES]
        cells.append(f"{statistics.fmean(p.gaussians for p in lasts):,.0f}")
        cells += [_spread([p.cpu_s for p in lasts], 0), _spread([p.wall_s for p in lasts], 0)]
        lines.append(f"| {variant.name} | " + " | ".join(cells) + " |")
    lines += ["", "Mean ± standard deviation over all scenes and seeds, at the end.", ""]
    for clock, word in CLOCKS.items():
        goal = ", ".join(
            f"{TITLES[n]} {targets[n]:g}" if n in targets else TITLES[n] for n in TITLES
        )
        lines += [
            f"Until the target ({goal}; where none is given, what {first.name} ends with on the "
            f"same scene with the same seed), {word} time over that of {first.name}'s whole "
            f"training: median (smallest to largest), and how many trainings get there.",
            "",
            "| | " + " | ".join(TITLES.values()) + " | all of them |",
            "|---|" + "---|" * (len(TITLES) + 1),
        ]
        for variant, own in by_variant.items():
            cells = [
                _ratio_cell(own, by_variant[first], [n], targets, clock) for n in (*TITLES,)
            ] + [_ratio_cell(own, by_variant[first], [*TITLES], targets, clock)]
            lines.append(f"| {variant.name} | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _by_variant(curves: Sequence[Curve]) -> dict[Variant, list[Curve]]:
    found: dict[Variant, list[Curve]] = {}
    for curve in curves:
        found.setdefault(curve.job.variant, []).append(curve)
    return found


def _spread(values: Sequence[float], digits: int = 2) -> str:
    if not values:
        return "–"
    deviation = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):.{digits}f}{deviation}"


def _ratio_cell(
    own: Sequence[Curve],
    first: Sequence[Curve],
    scores: Sequence[str],
    targets: Mapping[str, float],
    clock: str,
) -> str:
    """Time until all the scores are reached, over the first variant's whole time."""
    reference = {(curve.job.scene, curve.job.seed): curve.points[-1] for curve in first}
    pairs = [
        (curve, reference[curve.job.scene, curve.job.seed])
        for curve in own
        if (curve.job.scene, curve.job.seed) in reference
    ]
    found = [_ratio(curve, end, scores, targets, clock) for curve, end in pairs]
    ratios = sorted(ratio for ratio in found if ratio is not None)
    if not ratios:
        return f"0 of {len(found)}"
    middle = statistics.median(ratios)
    return f"{middle:.2f} ({ratios[0]:.2f}–{ratios[-1]:.2f}), {len(ratios)} of {len(found)}"


def _ratio(
    curve: Curve, end: Point, scores: Sequence[str], targets: Mapping[str, float], clock: str
) -> float | None:
    times = []
    for name in scores:
        target = targets.get(name, end.scores.get(name))
        if target is not None:
            times.append(time_until(curve.points, name, target, clock))
    reached = [time for time in times if time is not None]
    if not times or len(reached) < len(times):
        return None
    return max(reached) / float(getattr(end, clock))


def draw(curves: Sequence[Curve], path: Path) -> None:
    """Write the chart as PNG: each score over processor seconds, mean over scenes and seeds.

    Raises:
        ImportError: matplotlib is not installed.
    """
    import matplotlib  # part of the extra "bench" alone

    matplotlib.use("Agg")
    from matplotlib import pyplot

    shown = [n for n in TITLES if any(n in p.scores for c in curves for p in c.points)]
    figure, panels = pyplot.subplots(1, len(shown), figsize=(4.2 * len(shown), 4.4), squeeze=False)
    for axes, name in zip(panels[0], shown, strict=True):
        for index, (variant, own) in enumerate(_by_variant(curves).items()):
            points = _mean_points(own, name)
            axes.plot(
                *zip(*points, strict=True),
                marker="o",
                markersize=3,
                color=f"C{index}",
                label=variant.name,
            )
        axes.set(xlabel="processor seconds", ylabel=TITLES[name])
        axes.grid(which="both", alpha=0.25)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=3, frameon=False)
    rows = -(-len(labels) // 3)
    figure.tight_layout(rect=(0, 0.03 + 0.05 * rows, 1, 1))
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def _mean_points(curves: Sequence[Curve], score: str) -> list[tuple[float, float]]:
    """Mean time and mean score at each step that all curves have."""
    together = zip(*(curve.points for curve in curves), strict=False)
    found = []
    for points in together:
        known = [point.scores[score] for point in points if score in point.scores]
        if known:
            found.append((statistics.fmean(p.cpu_s for p in points), statistics.fmean(known)))
    return found
