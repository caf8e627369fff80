"""How long a single command is expected to take, from the model of the pipeline's costs."""

from __future__ import annotations

from pathlib import Path

from mrgs.errors import MrgsError
from mrgs.export.write import BAKING
from mrgs.pipeline.computer import measure_computer
from mrgs.pipeline.costs import Workload, stage_costs
from mrgs.pipeline.forecast import Forecast
from mrgs.pipeline.intake import take_in
from mrgs.pipeline.plan import planned_seconds
from mrgs.pipeline.quality import QUALITIES
from mrgs.prepare.contract import Progress
from mrgs.prepare.options import PrepareOptions
from mrgs.runs.open import Run
from mrgs.scene import Scene

THERMAL_CAMERA_STEPS = {
    "looking for the target": (0.0, 0.1),
    "reading pairs": (0.1, 0.3),
    "searching the thermal camera": (0.3, 0.35),
    "matching": (0.35, 1.0),
}
"""Where in this part of ``prepare`` its steps begin and end, roughly: each counts its own."""


def left_in_stage(forecast: Forecast, text: str, done: int, total: int) -> float | None:
    """Seconds left of a stage, from what it reports: a part, or "title: step" as ``prepare``."""
    title, _, step = text.partition(": ")
    part = step if title == "poses" else title
    share = done / total if total else None
    if share is not None and step in THERMAL_CAMERA_STEPS and title == "thermal camera":
        start, end = THERMAL_CAMERA_STEPS[step]
        share = start + share * (end - start)
    return forecast.left(part, share)


def expect_prepare(
    photos: Path, options: PrepareOptions, progress: Progress | None = None
) -> Forecast | None:
    """Of ``mrgs prepare``; None for photos that cannot be used, of which it says more itself.

    Args:
        photos: their folder.
        options: facts about the photos.
        progress: called with "pairs: step", the number of files that are done, and of all.
    """

    def report(step: str, done: int, total: int) -> None:
        if progress is not None:
            progress(f"pairs: {step}", done, total)

    try:
        intake = take_in(photos, options, report)
    except MrgsError:
        return None
    if intake.kind == "scene":
        return None
    work = Workload.of(intake, QUALITIES["fast"])
    return Forecast(planned_seconds(stage_costs(work)["prepare"], measure_computer()))


def expect_export(run: Run, scene: Scene, format: str) -> Forecast:
    """Of ``mrgs export``."""
    costs, computer = stage_costs(Workload.of_run(run, scene)), measure_computer()
    parts = planned_seconds(costs["exports"], computer) | planned_seconds(costs["page"], computer)
    if format != "all":
        parts = {name: seconds for name, seconds in parts.items() if name in (BAKING, format)}
    return Forecast(parts)


def expect_report(run: Run, scene: Scene) -> Forecast:
    """Of ``mrgs report``."""
    costs = stage_costs(Workload.of_run(run, scene))["report"]
    return Forecast(planned_seconds(costs, measure_computer()))
