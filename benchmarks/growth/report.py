"""The results as tables and a chart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.growth.plan import AXES, Case

TITLES = {
    "gaussians": "Gaussians",
    "photos": "pairs of photos",
    "pixels": "pixels of a photo",
    "threads": "threads",
}
LIMITED = ("gaussians", "pixels")
"""Axes along which memory ends: photos that do not fit are read again."""

MACHINES_GB = (8, 16, 32, 64)
KEPT = 0.9
"""Share of a machine's memory that a training can have."""


class Row(NamedTuple):
    """A case with its result.

    Attributes:
        case: what was trained.
        start_s: processor seconds before the end of the first step.
        step_s: processor seconds of a step, median.
        peak_bytes: largest resident memory of the process.
        estimated_bytes: what was said of it before the training.
    """

    case: Case
    start_s: float
    step_s: float
    peak_bytes: int
    estimated_bytes: int

    @property
    def off(self) -> float:
        """By which share of the peak the estimate is off."""
        return self.estimated_bytes / self.peak_bytes - 1


def exponents(points: Sequence[tuple[float, float]]) -> list[float]:
    """Of a cost: b in y ~ x^b between each two points that follow one another."""
    return [math.log(y1 / y0) / math.log(x1 / x0) for (x0, y0), (x1, y1) in pairwise(points)]


def most(rows: Sequence[Row], gigabytes: float) -> float:
    """How many fit into so much memory, on the line through the last two rows."""
    first, last = rows[-2:]
    each = (last.peak_bytes - first.peak_bytes) / (last.case.x - first.case.x)
    return last.case.x + (KEPT * gigabytes * 1e9 - last.peak_bytes) / each


def to_markdown(rows: Sequence[Row], machine: dict[str, Any]) -> str:
    """A table for each axis, the exponents, what fits into memory, and the estimates."""
    lines = [
        "# How the cost of a training grows",
        "",
        f"{machine['processor']}; python {machine['python']}, torch {machine['torch']}, numba "
        f"{machine['numba']}. `mrgs-plus`, processor seconds of a step (median) and before the end "
        f"of the first one, largest resident memory of the process. *Exponent*: b in cost ~ x^b, "
        f"from the row above.",
        "",
    ]
    for axis in AXES:
        own = [row for row in rows if row.case.axis == axis]
        if own:
            lines += [*_axis_table(axis, own), ""]
    estimates = [row for row in rows if row.case.axis == "estimate"]
    if estimates:
        lines += _estimate_table(estimates)
    return "\n".join(lines).rstrip() + "\n"


def _axis_table(axis: str, rows: Sequence[Row]) -> list[str]:
    times, peaks = (
        ["", *(f"{b:.2f}" for b in exponents([(row.case.x, getattr(row, name)) for row in rows]))]
        for name in ("step_s", "peak_bytes")
    )
    lines = [
        f"## Over {TITLES[axis]}",
        "",
        f"{_fixed(axis, rows[0].case)}.",
        "",
        f"| {TITLES[axis]} | step, s | exponent | first step, s | peak, GB | exponent | estimate |",
        "|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row, time, peak in zip(rows, times, peaks, strict=True):
        lines.append(
            f"| {row.case.x:,} | {row.step_s:.3f} | {time} | {row.start_s:.1f} "
            f"| {row.peak_bytes / 1e9:.2f} | {peak} | {row.off:+.0%} |"
        )
    if axis in LIMITED and len(rows) > 1:
        ends = ", ".join(f"{_short(round(most(rows, size)))} in {size} GB" for size in MACHINES_GB)
        lines += [
            "",
            f"On a line through the last two peaks, {KEPT:.0%} of the memory hold {ends}.",
        ]
    return lines


def _fixed(axis: str, case: Case) -> str:
    """What stays along an axis."""
    numbers = {
        "gaussians": f"{case.gaussians:,} Gaussians",
        "photos": f"{case.photos} pairs of photos",
        "pixels": f"{case.size[0]}×{case.size[1]}",
        "threads": "one thread",
    }
    return ", ".join(text for name, text in numbers.items() if name != axis)


def _estimate_table(rows: Sequence[Row]) -> list[str]:
    worst = max(rows, key=lambda row: abs(row.off))
    lines = [
        "## The estimate before a training",
        "",
        f"Worst: {worst.off:+.0%}.",
        "",
        "| method | Gaussians | image | pairs | peak, GB | estimate, GB | off by |",
        "|---|---:|---|---:|---:|---:|---:|",
    ]
    for row in rows:
        case = row.case
        lines.append(
            f"| {case.method} | {case.gaussians:,} | {case.size[0]}×{case.size[1]} | {case.photos} "
            f"| {row.peak_bytes / 1e9:.2f} | {row.estimated_bytes / 1e9:.2f} | {row.off:+.0%} |"
        )
    return lines


def draw(rows: Sequence[Row], path: Path) -> None:
    """Write the chart as PNG: time of a step above, memory below, one column for each axis.

    Raises:
        ImportError: matplotlib is not installed.
    """
    import matplotlib  # part of the extra "bench" alone

    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    curves = {
        axis: own
        for axis in AXES
        if axis != "threads" and (own := [row for row in rows if row.case.axis == axis])
    }
    if not curves:
        return
    figure, panels = pyplot.subplots(
        2, len(curves), figsize=(3.8 * len(curves), 6.4), sharex="col", sharey="row", squeeze=False
    )
    for column, (axis, own) in enumerate(curves.items()):
        xs = [row.case.x for row in own]
        for panel, color, ys in (
            (panels[0][column], "C0", [row.step_s for row in own]),
            (panels[1][column], "C3", [row.peak_bytes / 1e9 for row in own]),
        ):
            panel.plot(xs, ys, marker="o", markersize=4, color=color)
            panel.set(xscale="log", yscale="log")
            panel.set_xticks(xs, [_short(x) for x in xs], rotation=45)
            panel.set_xticks([], minor=True)
            panel.grid(which="both", alpha=0.25)
            _label_exponents(panel, xs, ys)
        panels[0][column].set_title(_fixed(axis, own[0].case), fontsize=9)
        panels[1][column].set_xlabel(TITLES[axis])
    for row_of_panels, label in zip(
        panels, ("processor seconds of a step", "peak, GB"), strict=True
    ):
        row_of_panels[0].set_ylabel(label)
        row_of_panels[0].yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
        row_of_panels[0].yaxis.set_major_formatter("{x:g}")
        row_of_panels[0].yaxis.set_minor_formatter("")
    figure.suptitle("How the cost of a training grows; the numbers are exponents", fontsize=11)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def _short(count: int) -> str:
    """A count as an axis shows it: 50 K, 1.2 M."""
    for size, letter in ((1_000_000, "M"), (1_000, "K")):
        if count >= size:
            return f"{count / size:.3g} {letter}"
    return str(count)


def _label_exponents(panel: Any, xs: Sequence[float], ys: Sequence[float]) -> None:
    """The exponent of each stretch of a curve, beside its middle."""
    points = list(zip(xs, ys, strict=True))
    for exponent, ((x0, y0), (x1, y1)) in zip(exponents(points), pairwise(points), strict=True):
        panel.annotate(
            f"{exponent:.2f}",
            (math.sqrt(x0 * x1), math.sqrt(y0 * y1)),
            xytext=(0, 7),
            textcoords="offset points",
            ha="right",
            fontsize=8,
        )
