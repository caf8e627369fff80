"""Text of unknown origin in Markdown and in files for spreadsheets."""

from __future__ import annotations

import html
import re

from mrgs.errors import printable

_ACTIVE = re.compile(r"[\\`*\[\]|~$@]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])|(?<=:)//|(?<=www)\.")
"""What Markdown reads as markup in any place: code, emphasis, links, table cells, formulas."""

_AT_START = re.compile(r"^\s*(#|[-+=]|\d+(?=[.)]))")
"""What makes a line a heading or an item of a list."""

_FORMULA = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")
"""How cells begin, after blanks, that a spreadsheet runs as a formula; the last four are as wide as
letters of Chinese and Japanese."""


def without_controls(text: str) -> str:
    """Lines of text with escapes for what is not printable."""
    return "\n".join(map(printable, text.split("\n")))


def escape_markdown(text: str) -> str:
    """Text on one line that shows as it is, wherever it is put: no HTML, link, markup or cell."""
    line = printable(" ".join(text.split()))
    escaped = _ACTIVE.sub(lambda found: f"\\{found[0]}", html.escape(line, quote=False))
    return _AT_START.sub(lambda m: f"{m[1]}\\" if m[1].isdigit() else f"\\{m[1]}", escaped)


def escape_cell(text: str) -> str:
    """Text for a cell that no spreadsheet runs as a formula."""
    quote = "'" if text.lstrip().startswith(_FORMULA) else ""
    return quote + without_controls(text)
