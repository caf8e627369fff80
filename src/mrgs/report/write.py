"""Writes the report: one HTML file with everything in it, for a browser or for print."""

from __future__ import annotations

from datetime import date
from pathlib import Path

from mrgs.pictures.html import PAGE_STYLE, write_html
from mrgs.report.sections import (
    capture_rows,
    find_shown_spots,
    read_contact_sheet,
    read_scores,
    training_rows,
)
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene


def write_report(run: Run, scene: Scene, path: Path) -> Path:
    """Write a page about the run for a thermographer; returns its path.

    It holds the hottest and the coldest spots with their positions and pictures, the scores and the
    contact sheet of ``RUN/eval`` (or how to get them), the data of the capture and of the training,
    and the limits of the measurement. The page needs no script and nothing from the network; its
    style sheet also serves printing on A4.

    Args:
        run: what ``load_run`` returns.
        scene: that the run was trained on, as ``run.load_scene()`` returns it.
        path: ends with .html.

    Raises:
        SceneError: a photo that is to be shown cannot be read.
        RunError: ``metrics.json`` or the contact sheet cannot be read, or the file cannot be
            written.
    """
    has_thermal = THERMAL in scene.modalities
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
        spots=find_shown_spots(run, scene) if has_thermal else None,
        has_thermal_gains=run.image_model.thermal_gain is not None,
        depends_on_view=has_thermal and run.model.gaussians.depends_on_view(THERMAL),
        capture=capture_rows(scene),
        notes=scene.notes,
        scores=read_scores(run),
        contact_sheet=read_contact_sheet(run),
        training=training_rows(run),
    )
