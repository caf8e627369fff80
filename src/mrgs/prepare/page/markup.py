"""Pieces of HTML; all text is escaped here."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape

from PIL import Image


def section(name: str, title: str, content: str) -> str:
    """A section with a heading, which links of the page can point to by its name."""
    return f'<section id="{escape(name)}"><h2>{escape(title)}</h2>{content}</section>'


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph, of a class of the style sheet if given."""
    return f"<p{_class(kind)}>{escape(text)}</p>"


def bullets(lines: Iterable[str]) -> str:
    """A list of sentences; nothing where there are none."""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else ""


def fact_table(rows: Iterable[tuple[str, str]]) -> str:
    """Names on the left, what is known on the right."""
    cells = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(text)}</td></tr>'
        for name, text in rows
    )
    return f'<table class="facts">{cells}</table>' if cells else ""


def column_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with a heading for each column."""
    head = "".join(f'<th scope="col">{escape(heading)}</th>' for heading in headings)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="wide">{table}</div>'


def folded(summary: str, content: str) -> str:
    """Content that opens at a click; it is always open in print."""
    return f"<details><summary>{escape(summary)}</summary>{content}</details>"


def figure(content: str, caption: str) -> str:
    """A picture or drawing with a caption."""
    return f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def picture(
    image: Image.Image, text: str, *, kind: str = "", quality: int = 80, png: bool = False
) -> str:
    """An image inside the page, as JPEG or PNG, with a text for those who cannot see it."""
    buffer = io.BytesIO()
    if png:
        image.save(buffer, "PNG", optimize=True)
    else:
        image.save(buffer, "JPEG", quality=quality)
    content = base64.b64encode(buffer.getvalue()).decode("ascii")
    size = f'width="{image.width}" height="{image.height}"'
    source = f"data:image/{'png' if png else 'jpeg'};base64,{content}"
    return f'<img{_class(kind)} {size} alt="{escape(text)}" src="{source}">'


def views_text(names: Sequence[str], most: int = 5) -> str:
    """How many views, and the first of them by name, in a sentence."""
    shown = ", ".join(names[:most])
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{len(names)} view{'' if len(names) == 1 else 's'} ({shown}{more})"


def _class(kind: str) -> str:
    return f' class="{escape(kind)}"' if kind else ""
