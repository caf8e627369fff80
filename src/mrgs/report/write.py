"""Writes the report: one HTML file with everything in it, for a browser or for print."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from mrgs.marks import open_marks
from mrgs.marks.tables import DASH, PART_NAMES
from mrgs.pictures.html import PAGE_STYLE, write_html
from mrgs.report.anomalies import Proposals, propose
from mrgs.report.copies import require_packages, write_copies
from mrgs.report.findings import (
    CHART_HEIGHT,
    CHART_LEFT,
    CHART_WIDTH,
    air_uncertainty,
    camera_effects,
    show_findings,
)
from mrgs.report.sections import contents_of
from mrgs.report.texts import Language, Texts
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene
from mrgs.survey import survey_of
from mrgs.system.torch_modes import own_modes
from mrgs.system.wording import quoted

Progress: TypeAlias = Callable[[int, int, str], None]
"""Called with the number of the part that begins, the number of parts, and the part's name."""

PARTS = ("hottest and coldest places", "measurements and pictures", "page")


@own_modes()
def report_run(
    run: Run,
    path: str | Path | None = None,
    language: Language = "en",
    pdf: bool = False,
    *,
    docx: bool = False,
    appendix: bool = False,
    scene: Scene | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write a page about a run for a thermographer, which also fits printing on A4; returns its
    path.

    It has the marks, where there are °C the hottest and the coldest places, the limits of the
    measurement, and what ``survey.yaml`` in the run's folder states, which is written to be filled
    in if there is none. The places are kept in ``marks.json`` until they are accepted as marks
    (``RunMarks.accept``) or dropped.

    Args:
        run: what ``load_run`` or ``train`` returns.
        path: ends with .html; ``report.html`` in the run's folder if None.
        language: of the page.
        pdf: also write a PDF beside it; needs mrgs[report].
        docx: also write a Word document beside it; needs mrgs[report].
        appendix: with the thermal camera's drift and shading, the training, and scores and contact
            sheet of ``RUN/eval``, or how to get them.
        scene: that the run was trained on, where it has been read before.
        progress: called before each of ``PARTS``.

    Raises:
        ConfigError: the survey has a value that cannot be, its logo cannot be read, or weasyprint
            or python-docx is not installed.
        SceneError: the scene, or a photo that is to be shown, cannot be read.
        RunError: scores or contact sheet cannot be read, or the file cannot be written.
    """

    def begin(part: int) -> None:
        if progress is not None:
            progress(part + 1, len(PARTS), PARTS[part])

    require_packages(pdf, docx)
    scene, t = scene or run.load_scene(), Texts(language)
    survey = survey_of(run.folder.path)
    contents = contents_of(run, scene, survey, t, appendix)
    begin(0)
    marks = open_marks(run, scene)
    regions = marks.meter.regions(marks.marks)
    has_c = THERMAL in scene.modalities and scene.temperature is not None
    found = propose(marks, scene, regions, survey) if has_c else Proposals({}, 0)
    begin(1)
    camera = camera_effects(run, t)
    findings = show_findings(marks, regions, found.anomalies, scene, survey, t)
    begin(2)
    every = (*findings.marks, *(each["mark"] for each in findings.proposals))
    known = [mark["parts"] for mark in every if mark["around"]]
    parts = [name for name in PART_NAMES.values() if any(each[name] != DASH for each in known)]
    page = write_html(
        run.folder.path / "report.html" if path is None else Path(path),
        "report/report.html",
        styles=[PAGE_STYLE, "report/report.css"],
        quoted=quoted,
        **contents,
        camera=camera,
        findings=findings,
        every=every,
        held_back=found.held_back,
        judged=bool(findings.marks or marks.marks.dropped),
        assumptions=marks.meter.capture.notes if regions else (),
        doubts=() if marks.meter.uncertainty is None else marks.meter.uncertainty.notes,
        parts_of_uncertainty=parts,
        camera_is_known=PART_NAMES["camera"] in parts,
        air_around=f"{air_uncertainty(survey):g}",
        chart=(CHART_WIDTH, CHART_HEIGHT, CHART_LEFT),
    )
    write_copies(page, pdf, docx)
    return page
