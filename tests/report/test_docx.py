"""The report as a Word document, read back by the library that wrote it."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs import open_marks
from mrgs.app.cli import main
from mrgs.errors import ConfigError
from mrgs.pictures.drawing import blank, draw_text
from mrgs.report import report_run
from mrgs.report.copies import write_copies
from mrgs.runs.open import Run
from mrgs.scene import Scene
from mrgs.survey import Survey, write_survey

docx = pytest.importorskip("docx", reason="python-docx is not installed")

PICTURES = ".//{http://schemas.openxmlformats.org/drawingml/2006/wordprocessingDrawing}docPr"


def headings(document, level: int) -> list[str]:
    style = f"Heading {level}"
    return [each.text for each in document.paragraphs if each.style.name == style]


def rows(table) -> list[list[str]]:
    return [[cell.text for cell in row.cells] for row in table.rows]


@pytest.fixture
def written(run: Run, sharp: Scene, tmp_path: Path):
    """A German report of a spot and a line, with what the inspector states."""
    marks = open_marks(run, sharp)
    camera = sharp.train[0].cameras[next(iter(sharp.train[0].cameras))]
    middle = camera.width / 2, camera.height / 2
    marks.add("spot", camera, [middle], name="Sturz", note="feucht & kalt", severity="2")
    marks.add("line", camera, [(middle[0] - 3, middle[1]), (middle[0] + 3, middle[1])], name="L1")
    stated = Survey(client="Stadt X", statement="Erste Zeile\nzweite", hot_places=0, cold_places=0)
    write_survey(run.folder.path / "survey.yaml", stated)
    page = report_run(run, tmp_path / "report.html", "de", docx=True, appendix=True, scene=sharp)
    return docx.Document(str(page.with_suffix(".docx")))


def test_the_document_has_headings_tables_and_pictures_that_can_be_edited(written):
    assert {"Ergebnisse", "Bilder", "Grenzen der Messung"} <= {*headings(written, 1)}
    assert any(each.startswith("Sturz · ") for each in headings(written, 2))
    assert written.core_properties.title.startswith("Thermografiebericht")
    tables = [rows(table) for table in written.tables]
    measured = next(table for table in tables if table[0][0] == "Messstelle")
    assert [row[0] for row in measured[1:3]] == ["Sturz", "L1"]
    value = measured[1][1].replace("\u00a0", " ")
    assert 5 < float(value.split(" ± ")[0].replace(",", ".")) < 35
    assert measured[1][-1] == "feucht & kalt"
    assert ["Auftraggeber", "Stadt X"] in [
        row[:2] for table in written.tables for row in rows(table)
    ]
    assert "Erste Zeile\nzweite" in [each.text for each in written.paragraphs]
    assert "w:tblHeader" in written.tables[1]._tbl.xml
    assert {
        each.get(docx.oxml.ns.qn("w:val")) for each in written.styles.element.xpath("//w:lang")
    } == {"de-DE"}


def test_pictures_fit_the_page_and_a_profile_is_one_of_them(written):
    section = written.sections[0]
    across = section.page_width - section.left_margin - section.right_margin
    assert len(written.inline_shapes) >= 6
    assert all(0 < shape.width <= across for shape in written.inline_shapes)
    texts = [each.get("descr") for each in written.element.body.iterfind(PICTURES)]
    assert all(texts)
    shape = written.inline_shapes[texts.index("L1")]
    part = written.part.related_parts[shape._inline.graphic.graphicData.pic.blipFill.blip.embed]
    drawn = np.asarray(Image.open(io.BytesIO(part.blob)).convert("RGB")).astype(int)
    blue = drawn[..., 2] - drawn[..., 0] > 100
    assert blue.any(axis=0).mean() > 0.7, "the curve goes from end to end"


def test_without_the_library_one_line_says_how_to_get_it(run, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "docx", None)
    with pytest.raises(ConfigError, match=r'pip install "mrgs\[report\]"') as refused:
        write_copies(Path("report.html"), docx=True)
    assert "\n" not in str(refused.value)
    assert main(["report", str(run.folder.path), "--docx"]) == 2
    assert "python-docx" in capsys.readouterr().err
    assert not (run.folder.path / "report.docx").exists()


def converted(folder: Path, body: str, title: str = "Report"):
    """A Word document of a page that has this body."""
    page = folder / "page.html"
    text = f'<html lang="en"><head><title>{title}</title></head><body>{body}</body></html>'
    page.write_text(text, encoding="utf-8")
    (path,) = write_copies(page, docx=True)
    return docx.Document(str(path))


def test_charts_have_the_letters_of_all_pictures(tmp_path):
    text = "−5 °C, é × 2"
    chart = f'<svg viewBox="0 0 120 30" fill="#5c646e"><text x="9" y="20">{text}</text></svg>'
    (image,) = converted(tmp_path, f"<div>{chart}</div>").part.package.image_parts
    expected = blank((360, 90))
    draw_text(expected, (27, 60), text, 39, (0x5C, 0x64, 0x6E))
    drawn = Image.open(io.BytesIO(image.blob)).convert("RGB")
    assert np.array_equal(np.asarray(drawn), np.asarray(expected))


def test_what_word_cannot_hold_is_cut_or_escaped(tmp_path):
    body = (
        "<h1>a\x01b</h1><p>c\x08d</p><table></table><table><tr></tr></table>"
        "<table><tr><td>e\x02f</td></tr></table>"
    )
    written = converted(tmp_path, body, "é\x03" + 300 * "x")
    assert [each.text for each in written.paragraphs[:2]] == [r"a\u0001b", r"c\u0008d"]
    assert [rows(table) for table in written.tables] == [[[r"e\u0002f"]]]
    title = written.core_properties.title
    assert (len(title), title[:8]) == (255, r"é\u0003x")
