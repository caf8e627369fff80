"""What a client reads first: cover, results, and how the pictures are coloured."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from PIL import Image

from mrgs import open_marks
from mrgs.errors import ConfigError
from mrgs.marks import Mark
from mrgs.marks.measure import MarkReading
from mrgs.pictures.page_data import PALETTE_CHOICES
from mrgs.report import report_run
from mrgs.report.copies import require_weasyprint
from mrgs.report.findings import like_parts
from mrgs.report.overview import Style
from mrgs.report.sections import read_logo
from mrgs.run_files.folder import RunFolder
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Scene, TemperatureRange
from mrgs.survey import SURVEY_FILE, Palette, Survey, read_survey, write_survey

STATED = Survey(
    object="House", client="Town", company="Surveyors", inside_c=35.0, outside_c=0.0,
    side="inside", least_f_rsi=0.7, palette="grey", scale_low_c=5.0, scale_high_c=35.0,
    logo="logo.png", standard="EN 13187", hot_places=2, cold_places=2,
)  # fmt: skip


def text_of(path: Path) -> str:
    """What a page says."""
    html = re.sub(r"(?s)<style>.*?</style>", "", path.read_text(encoding="utf-8"))
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", html))


@pytest.fixture(scope="module")
def stated(opened: Run, sharp: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report with five marks of which three are like each other, and with a survey."""
    folder = shutil.copytree(opened.folder.path, tmp_path_factory.mktemp("stated") / "run")
    for file in (*folder.glob("*marks*"), *folder.glob(SURVEY_FILE)):
        file.unlink()
    run = replace(opened, folder=RunFolder(folder))
    marks, camera = open_marks(run, sharp), sharp.train[0].images[THERMAL].camera
    for number, x in enumerate((28, 38, 48), start=1):
        marks.box(camera, (x, 24), (x + 8, 34), name=f"Window {number}")
    marks.spot(camera, (40, 30), name="Wall")
    marks.line(camera, [(30, 30), (50, 30)])
    write_survey(folder / SURVEY_FILE, STATED)
    Image.new("RGB", (900, 300), (200, 60, 20)).save(folder / "logo.png")
    return report_run(run, folder / "report.html", scene=sharp)


def test_the_results_come_before_what_they_rest_on(stated: Path):
    html = stated.read_text(encoding="utf-8")
    titles = re.findall(r"<h2>([^<]+)</h2>", html)
    assert titles == [
        "Results", "Pictures", "Survey", "Uncertainty", "Capture", "Limits of the measurement",
    ]  # fmt: skip
    cover, rest = html.split("<h2>Results</h2>")
    for words in ("House", "Town", 'class="logo"', "photo and thermal rendering"):
        assert words in cover
        assert words not in rest


def test_places_that_are_hot_or_cold_are_not_called_anomalies(stated: Path):
    assert "Hottest and coldest places" in text_of(stated)
    assert "nomal" not in text_of(stated)


def test_places_below_the_wanted_temperature_factor_are_listed(stated: Path):
    html = stated.read_text(encoding="utf-8")
    listed = html[html.index("Below f_Rsi 0.70") :]
    listed = listed[: listed.index("</p>")]
    factors = [float(each) for each in re.findall(r">(0\.\d\d)", listed)]
    assert factors
    assert max(factors) < 0.7
    rows = re.findall(r">(0\.\d\d)(?: ± [\d.]+)?</td>", html)
    assert len(factors) == sum(float(each) < 0.7 for each in rows)


def test_like_parts_are_compared_with_their_median():
    corners = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    means = {
        "Module 1": 20.0, "Module 2": 21.0, "Module_3": 27.5, "B1": 1.0, "B2": 2.0, "Door": 5.0,
        "Roof 1": 4.0, "Module 12": np.nan,
    }  # fmt: skip
    readings = [
        MarkReading(Mark(name, "box", corners, (0.5, -5.0, 0.5)), mean)
        for name, mean in means.items()
    ]
    assert like_parts(readings, TemperatureRange(0.0, 50.0)) == [
        {
            "name": "Module",
            "count": 3,
            "median": "21.0",
            "ends": [("Module 1", "−1.0"), ("Module_3", "+6.5")],
        }
    ]


def test_like_parts_are_in_the_report(stated: Path):
    assert re.search(r"Like parts .*Window 3 \d\d\.\d Window \d", text_of(stated))


def test_the_survey_gives_one_scale_to_all_pictures(
    stated: Path, opened: Run, sharp: Scene, tmp_path: Path
):
    assert "All thermal pictures have one scale, 5.0 °C to 35.0 °C." in text_of(stated)
    folder = shutil.copytree(stated.parent, tmp_path / "run")
    write_survey(folder / SURVEY_FILE, replace(STATED, scale_high_c=45.0))
    run = replace(opened, folder=RunFolder(folder))
    other = report_run(run, tmp_path / "other.html", scene=sharp)
    pictures = [
        dict(re.findall(r'alt="([^"]*)" src="(data:[^"]+)"', page))
        for page in (path.read_text(encoding="utf-8") for path in (stated, other))
    ]
    thermal = {name for name in pictures[0] if "thermal" in name}
    assert len(thermal) >= 3
    assert pictures[0].keys() == pictures[1].keys()
    assert [name for name in thermal if pictures[0][name] == pictures[1][name]] == []
    assert Style("grey", (5.0, 35.0)).scale((1.0, 2.0), None)[:3] == ("grey", 5.0, 35.0)
    assert Style().scale((1.0, 2.0), TemperatureRange(0.0, 9.0))[:4] == (
        "inferno",
        1,
        2,
        "°C",
    )


def test_without_a_scale_of_its_own_the_report_says_that_scales_differ(
    run: Run, sharp: Scene, tmp_path: Path
):
    open_marks(run).spot(sharp.train[0].images[THERMAL].camera, (40, 30))
    path = report_run(run, tmp_path / "report.html", scene=sharp)
    assert "Each picture has a scale of its own" in text_of(path)
    assert read_survey(run.folder.path / SURVEY_FILE) == Survey()


def test_without_celsius_it_is_a_relative_model(run: Run, sharp: Scene, tmp_path: Path):
    unknown = replace(run, facts=run.facts._replace(temperature=None))
    scene = replace(sharp, temperature=None)
    marks, camera = open_marks(unknown, scene), scene.train[0].images[THERMAL].camera
    marks.spot(camera, (40, 30), name="Wall")
    marks.spot(camera, (30, 30), name="Door")
    marks.refer_to("Wall")
    path = report_run(unknown, tmp_path / "report.html", scene=scene)
    results = text_of(path).split(" Capture ")[0]
    assert "Relative thermal model: balls" in results
    assert "Δ to Wall" in results
    assert re.search(r"Door 0\.\d{3}", results)
    assert not re.search(r"ΔT|, K\b|\d °C|°C [^.]|\bH1\b|Hottest|nomal", results)
    assert not marks.marks.proposals


def test_a_logo_that_cannot_be_read_is_named(tmp_path: Path):
    Image.new("RGB", (9, 9)).save(tmp_path / "logo.png")
    whole = (tmp_path / "logo.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[:40])
    (tmp_path / "drawn.eps").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    Image.new("RGB", (9, 9)).save(tmp_path / "moving.gif")
    os.mkfifo(tmp_path / "pipe.png")
    for name in ("missing.svg", "cut.png", "drawn.eps", "moving.gif", "pipe.png", "."):
        with pytest.raises(ConfigError, match=r"logo: .*give a PNG or JPEG file"):
            read_logo(Survey(logo=name), tmp_path)
    assert read_logo(Survey(logo="logo.png"), tmp_path) is not None


def test_the_survey_knows_the_palettes_and_both_ends_of_a_scale():
    assert get_args(Palette) == tuple(PALETTE_CHOICES)
    assert STATED.scale == (5.0, 35.0)
    assert Survey().scale is None
    with pytest.raises(ConfigError, match="both"):
        Survey(scale_low_c=5.0)
    with pytest.raises(ConfigError, match="above"):
        Survey(scale_low_c=5.0, scale_high_c=5.0)


def tables_of(sheet: Any) -> Iterator[str]:
    """The first words of the tables on a page."""
    for box in sheet.descendants():
        if box.element_tag == "table" and type(box).__name__ == "TableBox":
            words = (each.text for each in box.descendants() if getattr(each, "text", "").strip())
            yield " ".join(next(words, "") for _ in range(3))


@pytest.mark.slow
@pytest.mark.usefixtures("pango")
def test_on_paper_it_is_short_and_its_tables_are_whole(stated: Path):
    document = require_weasyprint().HTML(string=stated.read_text(encoding="utf-8")).render()
    sheets = [page._page_box for page in document.pages]
    assert len(sheets) <= 6
    tables = [table for sheet in sheets for table in tables_of(sheet)]
    assert len(tables) == len(set(tables)) > 6
    for sheet in sheets[:-1]:
        bottom = sheet.content_box_y() + sheet.height
        used = max(
            box.position_y + box.height
            for box in sheet.descendants()
            if getattr(box, "text", "").strip() or box.element_tag == "img"
        )
        assert used > bottom - 0.35 * sheet.height
