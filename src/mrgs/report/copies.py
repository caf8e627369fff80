"""Copies of a page of one HTML file: a PDF, and a Word document to be edited."""

from __future__ import annotations

import base64
import io
import logging
import re
import warnings
from collections.abc import Sequence
from datetime import datetime, timezone
from itertools import zip_longest
from pathlib import Path
from typing import Any

from PIL import Image, ImageColor, ImageDraw, ImageFile

from mrgs.errors import ConfigError
from mrgs.pictures.drawing import draw_text
from mrgs.pictures.escape import without_controls
from mrgs.pictures.html import inline_image
from mrgs.system.atomic import replacing


def require_packages(pdf: bool = False, docx: bool = False) -> None:
    """Check that the wanted copies can be written. ConfigError if weasyprint with its library Pango
    or python-docx is not installed."""
    if pdf:
        require_weasyprint()
    if docx:
        require_docx()


def write_copies(page: Path, pdf: bool = False, docx: bool = False) -> list[Path]:
    """Write the wanted copies beside a page; returns the paths. ConfigError as for
    ``require_packages``, RunError if a file cannot be written."""
    kinds = {".pdf": (pdf, _write_pdf), ".docx": (docx, _write_docx)}
    paths = {page.with_suffix(suffix): write for suffix, (wanted, write) in kinds.items() if wanted}
    for path, write in paths.items():
        with replacing(path) as temporary:
            write(page, temporary)
    return [*paths]


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


def _write_pdf(page: Path, path: Path) -> None:
    """Write a page as PDF. Nothing outside the page is fetched."""
    weasyprint = require_weasyprint()
    logging.getLogger("weasyprint").setLevel(logging.CRITICAL)  # style sheets are for browsers too
    fetcher = weasyprint.urls.URLFetcher(allowed_protocols=["data"])
    text = page.read_text(encoding="utf-8")
    weasyprint.HTML(string=text, url_fetcher=fetcher).write_pdf(path)


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


def _write_docx(page: Path, path: Path) -> None:
    """Write a page as a Word document, with its headings and tables; profiles become pictures."""
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
    document.save(str(path))


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
