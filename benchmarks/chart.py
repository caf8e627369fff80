"""How the cost grows with the Gaussians and with the pixels: one chart, both axes logarithmic."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.plan import GAUSSIANS, SIZES

FIXED_SIZE = (640, 480)
FIXED_GAUSSIANS = 50_000

CURVES = (
    ("mrgs", "step", "MrGS step"),
    ("3dgs-rgbt", "step", "3DGS_RGB-T step"),
    ("rasterizer", "forward + backward", "rasterizer, forward + backward"),
    ("render", "render", "rendering only"),
    ("losses", "L1 + D-SSIM, 4 channels", "L1 + D-SSIM"),
    ("heads", "colours", "colour head"),
    ("heads", "temperatures", "temperature branch"),
    ("densification", "rows moved and neighbours searched", "densification event"),
    ("adam", "Adam", "Adam"),
)
"""Group, stage and label of each line."""


def points(
    cases: Sequence[dict[str, Any]], group: str, stage: str, along: str
) -> list[tuple[int, float]]:
    """(x, ms) of a stage: along "gaussians" at the fixed image size, or along "pixels" at the fixed
    N.

    Empty where the stage does not depend on x.
    """
    found = []
    for case in cases:
        if case["group"] != group or stage not in case.get("timings", {}):
            continue
        pixels = None if case["width"] is None else case["width"] * case["height"]
        x, other = (
            (case["gaussians"], case["width"])
            if along == "gaussians"
            else (pixels, case["gaussians"])
        )
        fixed = FIXED_SIZE[0] if along == "gaussians" else FIXED_GAUSSIANS
        if x is not None and other in (None, fixed):
            found.append((x, case["timings"][stage]["median_ms"]))
    return sorted(found)


def draw(cases: Sequence[dict[str, Any]], path: Path) -> None:
    """Write the chart as PNG.

    Raises:
        ImportError: matplotlib is not installed.
    """
    import matplotlib  # part of the extra "bench" alone

    matplotlib.use("Agg")
    from matplotlib import pyplot

    width, height = FIXED_SIZE
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 5.2), sharey=True)
    counts = {count: f"{count:,}" for count in GAUSSIANS}
    sizes = {w * h: f"{w}×{h}" for w, h in SIZES}
    for axes, along, ticks, title in (
        (left, "gaussians", counts, f"Gaussians, at {width}×{height}"),
        (right, "pixels", sizes, f"image, with {FIXED_GAUSSIANS:,} Gaussians"),
    ):
        for index, (group, stage, label) in enumerate(CURVES):
            curve = points(cases, group, stage, along)
            if curve:
                axes.plot(
                    *zip(*curve, strict=True),
                    marker="o",
                    markersize=4,
                    color=f"C{index}",
                    label=label,
                )
        axes.set(xscale="log", yscale="log", xlabel=title)
        axes.set_xticks([*ticks], [*ticks.values()])
        axes.set_xticks([], minor=True)
        axes.grid(which="both", alpha=0.25)
    left.set_ylabel("median, ms")
    handles: dict[str, Any] = {}
    for axes in (left, right):
        handles |= {
            label: line for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=5, frameon=False)
    figure.tight_layout(rect=(0, 0.1, 1, 1))
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
