"""Writes the report: one HTML file with everything in it, for a browser or for print."""

from __future__ import annotations

from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import TypeAlias

from mrgs.marks.emissivity import records_of
from mrgs.pictures.html import PAGE_STYLE, write_html
from mrgs.report.marks import CHART_HEIGHT, CHART_LEFT, CHART_WIDTH, show_marks
from mrgs.report.sections import (
    capture_rows,
    find_named_spots,
    read_contact_sheet,
    read_scores,
    show_spots,
    training_rows,
)
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene

Progress: TypeAlias = Callable[[int, int, str], None]
"""Called with the number of the part that begins, the number of parts, and the part's name."""

PARTS = ("hottest and coldest spots", "pictures of the spots", "scores and page")


def report_run(run: Run, path: str | Path | None = None) -> Path:
    """Write a page about a run for a thermographer; returns its path. See ``write_report``.

    Args:
        run: what ``load_run`` or ``train`` returns.
        path: ends with .html; ``report.html`` in the run's folder if None.

    Raises:
        SceneError: the scene cannot be read.
        RunError: the scores or the contact sheet cannot be read, or the file cannot be written.
    """
    target = run.folder.path / "report.html" if path is None else Path(path)
    return write_report(run, run.load_scene(), target)


def write_report(run: Run, scene: Scene, path: Path, progress: Progress | None = None) -> Path:
    """Write a page about the run for a thermographer; returns its path.

    It holds the marks of the run, the hottest and the coldest spots with their positions and
    pictures, the scores and the contact sheet of ``RUN/eval`` (or how to get them), the data of
    the capture and of the training, and the limits of the measurement. The
    page needs no script and nothing from the network; its style sheet also fits printing on A4.

    Args:
        run: what ``load_run`` returns.
        scene: that the run was trained on, as ``run.load_scene()`` returns it.
        path: ends with .html.
        progress: called before each of ``PARTS``.

    Raises:
        SceneError: a photo that is to be shown cannot be read.
        RunError: ``metrics.json`` or the contact sheet cannot be read, or the file cannot be
            written.
    """

    def begin(part: int) -> None:
        if progress is not None:
            progress(part + 1, len(PARTS), PARTS[part])

    has_thermal = THERMAL in scene.modalities
    begin(0)
    named = find_named_spots(run, scene) if has_thermal else {}
    begin(1)
    spots = show_spots(named, run, scene) if named else None
    marks, assumptions = show_marks(run, scene)
    begin(2)
    return write_html(
        path,
        "report/report.html",
        title=f"Thermal report: {scene.name}",
        subtitle=f"{date.today().isoformat()}. Run {run.folder.path.resolve().name}, "
        f"{run.config.method}.",
        styles=[PAGE_STYLE, "report/report.css"],
        run_folder=run.folder.path,
        step=run.facts.step,
        has_thermal=has_thermal,
        temperature=scene.temperature,
        spots=spots,
        marks=marks,
        assumptions=assumptions,
        chart=(CHART_WIDTH, CHART_HEIGHT, CHART_LEFT),
        has_thermal_gains=run.image_model.thermal_gain is not None,
        depends_on_view=has_thermal and run.model.gaussians.depends_on_view(THERMAL),
        capture=capture_rows(scene),
        settings_known=any(record.parameters for record in records_of(scene)),
        notes=scene.notes,
        scores=read_scores(run),
        contact_sheet=read_contact_sheet(run),
        training=training_rows(run),
    )
