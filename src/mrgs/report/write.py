"""Writes the report: one HTML file with everything in it, for a browser or for print."""

from __future__ import annotations

from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import TypeAlias

from mrgs.marks import open_marks
from mrgs.marks.emissivity import records_of
from mrgs.marks.tables import DASH
from mrgs.pictures.html import PAGE_STYLE, write_html
from mrgs.report.conditions import conditions_of, stated_rows
from mrgs.report.marks import CHART_HEIGHT, CHART_LEFT, CHART_WIDTH, SHOWN_PARTS, show_marks
from mrgs.report.pdf import require_weasyprint, write_pdf
from mrgs.report.plan import draw_plan
from mrgs.report.sections import (
    capture_rows,
    find_named_spots,
    read_contact_sheet,
    read_scores,
    show_spots,
    training_rows,
)
from mrgs.report.texts import Language, Texts
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene
from mrgs.survey import SURVEY_FILE, Survey, read_survey

Progress: TypeAlias = Callable[[int, int, str], None]
"""Called with the number of the part that begins, the number of parts, and the part's name."""

PARTS = ("hottest and coldest spots", "pictures of the spots", "scores and page")


def report_run(
    run: Run, path: str | Path | None = None, language: Language = "en", pdf: bool = False
) -> Path:
    """Write a page about a run for a thermographer; returns its path. See ``write_report``.

    Args:
        run: what ``load_run`` or ``train`` returns.
        path: ends with .html; ``report.html`` in the run's folder if None.
        language: of the page.
        pdf: also write a PDF beside it; needs mrgs[report].

    Raises:
        ConfigError: the survey holds a value that cannot be, or weasyprint is not installed.
        SceneError: the scene cannot be read.
        RunError: the scores or the contact sheet cannot be read, or the file cannot be written.
    """
    target = run.folder.path / "report.html" if path is None else Path(path)
    if pdf:
        require_weasyprint()
    page = write_report(run, run.load_scene(), target, language=language)
    if pdf:
        write_pdf(page, page.with_suffix(".pdf"))
    return page


def write_report(
    run: Run,
    scene: Scene,
    path: Path,
    progress: Progress | None = None,
    language: Language = "en",
) -> Path:
    """Write a page about the run for a thermographer; returns its path.

    It holds what ``survey.yaml`` in the run's folder states, the marks of the run with their
    uncertainties, the hottest and the coldest spots with their positions and pictures, the data of
    the capture, the limits of the measurement, and in an appendix scores, the contact sheet of
    ``RUN/eval`` (or how to get them) and the training. The page needs no script and nothing from
    the network; its style sheet also fits printing on A4.

    Args:
        run: what ``load_run`` returns.
        scene: that the run was trained on, as ``run.load_scene()`` returns it.
        path: ends with .html.
        progress: called before each of ``PARTS``.
        language: of the page.

    Raises:
        ConfigError: the survey holds a value that cannot be.
        SceneError: a photo that is to be shown cannot be read.
        RunError: ``metrics.json`` or the contact sheet cannot be read, or the file cannot be
            written.
    """

    def begin(part: int) -> None:
        if progress is not None:
            progress(part + 1, len(PARTS), PARTS[part])

    t = Texts(language)
    survey = read_survey(run.folder.path / SURVEY_FILE)
    has_thermal = THERMAL in scene.modalities
    begin(0)
    named = find_named_spots(run, scene) if has_thermal else {}
    begin(1)
    spots = show_spots(named, run, scene) if named else None
    shown = show_marks(open_marks(run, scene), scene, survey)
    plan = draw_plan(scene, shown.places) if shown.marks else None
    begin(2)
    return write_html(
        path,
        "report/report.html",
        title=survey.title or t("Thermal report: {name}", name=scene.name),
        subtitle=_subtitle(run, survey),
        language=language,
        t=t,
        stated=stated_rows(survey, t),
        conditions=conditions_of(survey),
        standard=survey.standard,
        statement=survey.statement,
        styles=[PAGE_STYLE, "report/report.css"],
        run_folder=run.folder.path,
        step=run.facts.step,
        has_thermal=has_thermal,
        temperature=scene.temperature,
        spots=spots,
        marks=shown.marks,
        assumptions=shown.assumptions,
        doubts=shown.doubts,
        parts_of_uncertainty=SHOWN_PARTS if any(mark.around for mark in shown.marks) else (),
        has_factor=any(mark.factor != DASH for mark in shown.marks),
        plan=plan,
        chart=(CHART_WIDTH, CHART_HEIGHT, CHART_LEFT),
        has_thermal_gains=run.image_model.thermal_gain is not None,
        depends_on_view=has_thermal and run.model.gaussians.depends_on_view(THERMAL),
        capture=[(t(name), t(value)) for name, value in capture_rows(scene, survey)],
        settings_known=any(record.parameters for record in records_of(scene)),
        notes=scene.notes,
        scores=read_scores(run),
        contact_sheet=read_contact_sheet(run),
        training=[(t(name), value) for name, value in training_rows(run)],
    )


def _subtitle(run: Run, survey: Survey) -> str:
    """Who reports, and what the page was made from."""
    who = ", ".join(each for each in (survey.inspector, survey.company) if each)
    made = f"{date.today().isoformat()} · {run.folder.path.resolve().name} · {run.config.method}"
    return f"{who} · {made}" if who else made
