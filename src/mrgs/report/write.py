"""Writes the report: one HTML file with everything in it, for a browser or for print; and a PDF."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any, TypeAlias

from PIL import ImageFile

from mrgs.errors import ConfigError
from mrgs.marks import open_marks
from mrgs.marks.tables import DASH, PART_NAMES
from mrgs.pictures.html import PAGE_STYLE, write_html
from mrgs.pictures.settings import settings_of
from mrgs.report import sections
from mrgs.report.anomalies import Proposals, propose
from mrgs.report.findings import (
    CHART_HEIGHT,
    CHART_LEFT,
    CHART_WIDTH,
    air_uncertainty,
    camera_effects,
    show_findings,
)
from mrgs.report.texts import Language, Texts
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene
from mrgs.survey import survey_of
from mrgs.system.atomic import replacing
from mrgs.system.wording import quoted

Progress: TypeAlias = Callable[[int, int, str], None]
"""Called with the number of the part that begins, the number of parts, and the part's name."""

PARTS = ("hottest and coldest places", "measurements and pictures", "page")


def report_run(
    run: Run,
    path: str | Path | None = None,
    language: Language = "en",
    pdf: bool = False,
    *,
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
        appendix: with the thermal camera's drift and shading, the training, and scores and contact
            sheet of ``RUN/eval``, or how to get them.
        scene: that the run was trained on, where it has been read before.
        progress: called before each of ``PARTS``.

    Raises:
        ConfigError: the survey has a value that cannot be, its logo cannot be read, or weasyprint
            is not installed.
        SceneError: the scene, or a photo that is to be shown, cannot be read.
        RunError: scores or contact sheet cannot be read, or the file cannot be written.
    """

    def begin(part: int) -> None:
        if progress is not None:
            progress(part + 1, len(PARTS), PARTS[part])

    if pdf:
        require_weasyprint()
    scene, t = scene or run.load_scene(), Texts(language)
    survey = survey_of(run.folder.path)
    logo = sections.read_logo(survey, run.folder.path)
    has_thermal = THERMAL in scene.modalities
    begin(0)
    marks = open_marks(run, scene)
    regions = marks.meter.regions(marks.marks)
    has_c = has_thermal and scene.temperature is not None
    found = propose(marks, scene, regions, survey) if has_c else Proposals({}, 0)
    begin(1)
    findings = show_findings(marks, regions, found.anomalies, scene, survey, t)
    begin(2)
    every = (*findings.marks, *(each["mark"] for each in findings.proposals))
    known = [mark["parts"] for mark in every if mark["around"]]
    parts = [name for name in PART_NAMES.values() if any(each[name] != DASH for each in known)]
    page = write_html(
        run.folder.path / "report.html" if path is None else Path(path),
        "report/report.html",
        findings=findings,
        camera=camera_effects(run, t),
        title=survey.title or "",
        name=scene.name,
        subtitle=t.date(date.today()),
        logo=logo,
        cover=sections.stated_rows(survey, t, on_cover=True),
        language=language,
        t=t,
        survey=survey,
        stated=sections.stated_rows(survey, t),
        conditions=sections.conditions_of(survey, sections.thermal_pixel_m(scene)),
        styles=[PAGE_STYLE, "report/report.css"],
        quoted=quoted,
        run=run,
        has_thermal=has_thermal,
        temperature=scene.temperature,
        held_back=found.held_back,
        judged=bool(findings.marks or marks.marks.dropped),
        assumptions=marks.meter.capture.notes if regions else (),
        doubts=() if marks.meter.uncertainty is None else marks.meter.uncertainty.notes,
        parts_of_uncertainty=parts,
        camera_is_known=PART_NAMES["camera"] in parts,
        every=every,
        air_around=f"{air_uncertainty(survey):g}",
        chart=(CHART_WIDTH, CHART_HEIGHT, CHART_LEFT),
        depends_on_view=has_thermal and run.model.gaussians.depends_on_view(THERMAL),
        capture=sections.capture_rows(scene, survey, t),
        settings=settings_of(scene.records),
        setting_text=sections.setting_text,
        notes=[*(t(note) for note in scene.notes), *sections.crop_notes(run, t)],
        appendix=appendix,
        scores=sections.read_scores(run, t) if appendix else None,
        contact_sheet=sections.read_contact_sheet(run) if appendix else None,
    )
    if pdf:
        write_pdf(page, page.with_suffix(".pdf"))
    return page


_OR = "or print the page from a browser"


def require_weasyprint() -> Any:
    """Import the package weasyprint, without what it changes in Pillow: photos that are cut off
    would be read as if they were whole. Without HarfBuzz-Subset it makes larger files, and warns.
    ConfigError if it is not installed, or the library Pango that it needs."""
    reads_truncated = ImageFile.LOAD_TRUNCATED_IMAGES
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=DeprecationWarning, module="weasyprint")
            import weasyprint
    except ImportError:
        raise ConfigError(f'a PDF needs weasyprint: pip install "mrgs[report]"; {_OR}') from None
    except OSError as error:
        raise ConfigError(
            "a PDF needs the library Pango: apt install libpango-1.0-0 libpangoft2-1.0-0 "
            f"libharfbuzz-subset0 ({str(error).splitlines()[0]:.80}); {_OR}"
        ) from None
    finally:
        ImageFile.LOAD_TRUNCATED_IMAGES = reads_truncated
    return weasyprint


def write_pdf(page: Path, path: Path) -> Path:
    """Write a page of one HTML file as PDF; returns the path. Nothing outside the page is fetched.
    ConfigError if weasyprint is not installed, RunError if the file cannot be written."""
    weasyprint = require_weasyprint()
    logging.getLogger("weasyprint").setLevel(logging.CRITICAL)  # style sheets are for browsers too
    fetcher = weasyprint.urls.URLFetcher(allowed_protocols=["data"])
    text = page.read_text(encoding="utf-8")
    with replacing(path) as temporary:
        weasyprint.HTML(string=text, url_fetcher=fetcher).write_pdf(temporary)
    return path
