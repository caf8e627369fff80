"""That long texts stay on the page, on paper and on the screen of a phone."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mrgs import open_marks
from mrgs.report import report_run
from mrgs.report.copies import require_weasyprint
from mrgs.run_files.folder import RunFolder
from mrgs.runs.open import Run
from mrgs.scene import THERMAL
from tests.helpers.browsers import chromium, needs_chromium, new_page

LONG_WORD = "x" * 250
LONG_NAME = "Fensterlaibung_Nordseite_Obergeschoss_12"
LONG_TEXT = " ".join(["word"] * 300)


@pytest.fixture(scope="module")
def long_report(opened: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report with long words, names and texts, and with line breaks; only to be read."""
    folder = shutil.copytree(opened.folder.path, tmp_path_factory.mktemp("long") / "run")
    run = replace(opened, folder=RunFolder(folder))
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    survey = (
        f"object: {LONG_WORD}\naddress: |\n  Street 1\n  Town\nweather: {LONG_TEXT}\n"
        f"purpose: {LONG_TEXT}\nstatement: |\n  - one\n  - two\nstandard: EN 13187\n"
        f"precipitation: {LONG_WORD}\nside: inside\ninside_c: 35\noutside_c: 0\nhot_places: 0\n"
        "cold_places: 0\n"
    )
    (run.folder.path / "survey.yaml").write_text(survey, encoding="utf-8")
    marks.spot(camera, (20, 15), name=LONG_NAME, severity="needs repair soon, danger of fire, hot",
               note="What was seen there\nand a second line")  # fmt: skip
    marks.spot(camera, (22, 15), name="S2", note=LONG_WORD)
    marks.box(camera, (16, 12), (24, 18), name="B1", emissivity=0.8, reflected_c=-5.0)
    marks.refer_to("S2")
    return report_run(run, folder / "report.html", language="de")


@pytest.fixture(scope="module")
def sheets(long_report: Path) -> list[Any]:
    """The pages of the report on paper, as boxes; to lay them out takes seconds."""
    html = long_report.read_text(encoding="utf-8")
    document = require_weasyprint().HTML(string=html).render()
    return [page._page_box for page in document.pages]


def lines_of(sheet: Any) -> Iterator[Any]:
    """The boxes of a page's texts."""
    return (box for box in sheet.descendants() if getattr(box, "text", "").strip())


@pytest.mark.slow
@pytest.mark.usefixtures("pango")
def test_nothing_runs_off_the_paper(sheets: list[Any]):
    for sheet in sheets:
        right = sheet.content_box_x() + sheet.width
        wide = [box.text for box in lines_of(sheet) if box.position_x + box.width > right + 1]
        assert wide == []


@pytest.mark.slow
@pytest.mark.usefixtures("pango")
def test_names_of_rows_and_numbers_are_not_broken_into_letters(sheets: list[Any]):
    texts = [box.text.strip() for sheet in sheets for box in lines_of(sheet)]
    for whole in ("Objekt", "S2", "B1", "T_refl −5,0\xa0°C", "Adresse"):
        assert whole.replace("\xa0", " ") in [text.replace("\xa0", " ") for text in texts]
    assert [text for text in texts if text.startswith("mindestens")]
    assert [text for text in texts if re.fullmatch(r"0,\d\d ± 0,\d\d", text)]  # f_Rsi
    assert not [text for text in texts if text.endswith("T_re-")]


@pytest.mark.slow
@pytest.mark.usefixtures("pango")
def test_a_long_row_of_the_survey_leaves_no_page_half_empty(sheets: list[Any]):
    for sheet in sheets[:-1]:
        bottom = sheet.content_box_y() + sheet.height
        lowest = max(box.position_y for box in sheet.descendants() if box.element_tag)
        assert lowest > bottom - 0.4 * sheet.height


def test_lines_of_a_survey_stay_lines(long_report: Path):
    html = long_report.read_text(encoding="utf-8")
    style = re.sub(r"\s+", " ", html[: html.index("</style>")])
    assert re.search(r"\.facts td, \.said {[^}]*pre-line", style)
    assert "<td>Street 1\nTown" in html
    assert '<p class="said">- one\n- two' in html


def test_what_all_are_compared_with_is_named_once(long_report: Path):
    html = long_report.read_text(encoding="utf-8")
    start = html.index("Messstelle</th>")
    table = html[start : html.index("</table>", start)]
    assert table.count("gegenüber S2") == 1


@needs_chromium
@pytest.mark.slow
def test_the_report_fits_on_a_phone(long_report: Path):
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with chromium() as browser:
        page = new_page(browser, viewport={"width": 390, "height": 800})
        page.goto(long_report.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
