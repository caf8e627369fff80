"""Write the report: one HTML file with everything in it, to be read in a browser or printed to
PDF."""

from __future__ import annotations

from datetime import date
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template

from mrgs.report.sections import capture, contact_sheet, limits, metrics, spots, training
from mrgs.runs.open import Run
from mrgs.scene import Scene
from mrgs.system.atomic import replacing
from mrgs.system.webpage import policy_hash


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
    sections = [
        spots(run, scene),
        limits(
            scene.temperature,
            run.image_model.thermal_gain is not None,
            run.model.gaussians.temperature_depends_on_view,
        ),
        capture(scene),
        metrics(run),
        contact_sheet(run),
        training(run),
    ]
    style = files("mrgs.report").joinpath("report.css").read_text(encoding="utf-8")
    page = Template(
        files("mrgs.report").joinpath("report.html").read_text(encoding="utf-8")
    ).substitute(
        title=escape(f"Thermal report: {scene.name}"),
        subtitle=escape(
            f"{date.today().isoformat()}. Run {run.folder.path.resolve().name}, "
            f"{run.config.method}."
        ),
        version=escape(version("mrgs")),
        style=style,
        style_hash=policy_hash(style),
        sections="\n".join(sections),
    )
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path
