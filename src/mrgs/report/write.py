"""Writes the report: one HTML file with everything in it, for a browser or for print; from it a
PDF, and a Word document to be edited."""

from __future__ import annotations

import base64
import io
import logging
import re
import warnings
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from itertools import zip_longest
from pathlib import Path
from typing import Any, TypeAlias

from PIL import Image, ImageColor, ImageDraw, ImageFile

from mrgs.errors import ConfigError
from mrgs.marks import open_marks
from mrgs.marks.tables import DASH, PART_NAMES
from mrgs.pictures.drawing import draw_text
from mrgs.pictures.escape import without_controls
from mrgs.pictures.html import PAGE_STYLE, inline_image, write_html
from mrgs.report.anomalies import Proposals, propose
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

    if pdf:
        require_weasyprint()
    if docx:
        require_docx()
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
    if pdf:
        write_pdf(page, page.with_suffix(".pdf"))
    if docx:
        write_docx(page, page.with_suffix(".docx"))
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


def require_docx() -> Any:
    """Import the package python-docx. ConfigError if it is not installed."""
    try:
        import docx
    except ImportError:
        raise ConfigError('a Word file needs python-docx: pip install "mrgs[report]"') from None
    return docx


TEXT_MM, TALLEST_MM, LOGO_MM, MM_PER_PX = 174.0, 190.0, 40.0, 25.4 / 150
"""Width of the text on A4; a picture's largest height, a logo's largest width, and a pixel's."""

LONGEST_PROPERTY = 255
"""Characters of a document property, such as the title."""

HEADINGS = {"h1": 0, "h2": 1, "h3": 2}
STYLES = {"figcaption": "Caption", "li": "List Bullet", "p": None}
"""Levels of Word's headings, and names of its styles for paragraphs, by HTML's elements."""


def write_docx(page: Path, path: Path) -> Path:
    """Write a report's page of one HTML file as a Word document; returns the path. Headings and
    tables are Word's own, profiles become pictures. ConfigError if python-docx is not installed,
    RunError if the file cannot be written."""
    docx = require_docx()
    import lxml.html

    parser = lxml.html.HTMLParser(huge_tree=True)  # pictures of more than 10 MB
    html = lxml.html.document_fromstring(page.read_text(encoding="utf-8"), parser)
    document, mm, language = docx.Document(), docx.shared.Mm, html.get("lang")
    (section,) = document.sections
    section.page_width, section.page_height = mm(210), mm(297)
    section.left_margin = section.right_margin = mm((210 - TEXT_MM) / 2)
    for spelling in document.styles.element.xpath("//w:rPrDefault//w:lang"):
        country = {"en": "GB"}.get(language, language.upper())
        spelling.set(docx.oxml.ns.qn("w:val"), f"{language}-{country}")
    for style in (document.styles["Normal"], document.styles["Caption"]):
        style.font.name, style.font.size, style.font.bold = "Calibri", docx.shared.Pt(9.5), False
        style.font.color.rgb = docx.shared.RGBColor(28, 34, 41)
    about = document.core_properties
    title = without_controls(html.findtext(".//title") or "")
    about.title, about.author, about.comments = title[:LONGEST_PROPERTY], "mrgs", ""
    about.created = about.modified = datetime.now(timezone.utc)
    for element in html.find("body"):
        _add(document, element)
    with replacing(path) as temporary:
        document.save(str(temporary))
    return path


def _add(document: Any, element: Any) -> None:
    """An element of the page as paragraphs, tables and pictures at the end of a document."""
    kind, children = element.tag, list(element)
    if kind in HEADINGS:
        parts = filter(None, map(_text, children or [element]))
        document.add_heading(" · ".join(parts), HEADINGS[kind])
    elif kind == "table":
        _add_table(document, element.xpath(".//tr"))
    elif element.get("class") == "sign":
        for text in ("_" * 30 + "\t" + "_" * 30, "\t".join(map(_text, children))):
            stops = document.add_paragraph(text).paragraph_format.tab_stops
            stops.add_tab_stop(document.sections[0].page_width // 2)
    elif kind in STYLES and (text := _text(element)):
        document.add_paragraph(text, STYLES[kind])
    elif kind == "footer":
        oxml, line = require_docx().oxml, document.sections[0].footer.paragraphs[0]
        line.text = f"{_text(element)}\t\t"
        line._p.append(number := oxml.OxmlElement("w:fldSimple"))
        number.set(oxml.ns.qn("w:instr"), "PAGE")
    elif kind in _PICTURES or (children and all(each.tag == "img" for each in children)):
        _add_pictures(document, children if kind not in _PICTURES else [element])
    else:
        for each in children:
            _add(document, each)


_PICTURES = ("img", "svg")
_AS_WRITTEN = "ancestor-or-self::*[contains(@class, 'said') or contains(@class, 'facts')]"


def _text(element: Any) -> str:
    """The text of an element; line breaks count where the page has them, in what people wrote.
    Characters that XML forbids become escapes."""
    parts = []
    for text in element.xpath(".//text()"):
        owner = text.getparent().getparent() if text.is_tail else text.getparent()
        written = text if owner.xpath(_AS_WRITTEN) else re.sub(r"\s+", " ", text)
        parts.append(f"_{written}" if owner.tag == "sub" else written)
    whole = without_controls("".join(parts).strip())
    return whole.replace(" ", "\u00a0") if "n" in element.get("class", "").split() else whole


def _add_table(document: Any, rows: Sequence[Any]) -> None:
    """A table with borders, whose headings each page repeats. A column is as wide as its longest
    word asks for, and wider for long texts. Nothing where there are no cells."""
    docx = require_docx()
    texts = [[_text(cell) for cell in row] for row in rows]
    if not any(texts):
        return
    asked = [
        max(4 + max(map(len, text.split(" "))) + min(len(text), 80) // 4 for text in column)
        for column in zip_longest(*texts, fillvalue="")
    ]
    table = document.add_table(len(rows), len(asked), "Table Grid")
    widths = [docx.shared.Mm(TEXT_MM * each / sum(asked)) for each in asked]
    for column, width in zip(table.columns, widths, strict=True):
        column.width = width
    for row, sources, own in zip(table.rows, rows, texts, strict=True):
        for cell, width, source, text in zip(row.cells, widths, sources, own, strict=False):
            cell.width, run = width, cell.paragraphs[0].add_run(text)
            run.bold = source.tag == "th" or "strong" in source.get("class", "")
            run.font.size = docx.shared.Pt(9 if len(asked) < 5 else 7.5)
    if all(cell.tag == "th" for cell in rows[0]):
        table.rows[0]._tr.get_or_add_trPr().append(docx.oxml.OxmlElement("w:tblHeader"))
    document.add_paragraph()


def _add_pictures(document: Any, elements: Sequence[Any]) -> None:
    """Pictures beside each other in one paragraph, on the page of what follows."""
    mm = require_docx().shared.Mm
    paragraph = document.add_paragraph()
    paragraph.paragraph_format.keep_with_next = True
    for element in elements:
        source, width = element.get("src"), 110.0
        if element.tag == "svg":
            source = inline_image(_drawn(element), "", png=True).source
        else:
            high_px, wide_px = int(element.get("height")), int(element.get("width"))
            widest = LOGO_MM if element.get("class") == "logo" else TEXT_MM / len(elements) - 2
            width = min(widest, TALLEST_MM * wide_px / high_px, MM_PER_PX * wide_px)
        content = io.BytesIO(base64.b64decode(source.partition(",")[2]))
        inline = paragraph.add_run().add_picture(content, mm(width))._inline
        paragraph.add_run(" ")
        label = element.get("alt") or element.get("aria-label") or ""
        inline.docPr.set("descr", without_controls(label))
        inline.attrib.update({"distL": "0", "distR": "0"})  # LibreOffice's default is 3 mm


def _drawn(svg: Any) -> Image.Image:
    """A chart of the page, of lines, texts and a path of straight lines, as a picture."""
    scale = 3  # pixels for each unit of the chart

    def scaled(numbers: str) -> list[float]:
        return [scale * float(each) for each in re.findall(r"[\d.]+", numbers)]

    _, _, width, height = scaled(svg.get("viewbox"))
    image = Image.new("RGB", (round(width), round(height)), "white")
    draw, color = ImageDraw.Draw(image), ImageColor.getrgb(svg.get("fill"))[:3]
    for part in svg:
        if part.tag == "text":
            x, y = scaled(f"{part.get('x')} {part.get('y')}")
            anchor = "rs" if part.get("text-anchor") == "end" else "ls"
            draw_text(image, (x, y), part.text, 13 * scale, color, anchor)
        else:
            path = part.get("d") or "{x1} {y1} {x2} {y2}".format_map(part.attrib)
            for piece in path.strip("M").split("M"):
                thickness = round(scale * float(part.get("stroke-width", 1)))
                draw.line(scaled(piece), part.get("stroke"), thickness, joint="curve")
    return image
