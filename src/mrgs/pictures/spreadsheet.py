"""Text of unknown origin in files for spreadsheets."""

from __future__ import annotations

_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\uff1d", "\uff0b", "\uff0d", "\uff20")
"""How cells begin that a spreadsheet runs as a formula; the last four are as wide as letters of
Chinese and Japanese."""


def escape_cell(text: str) -> str:
    """Text for a cell that no spreadsheet runs as a formula."""
    return f"'{text}" if text.startswith(_FORMULA) else text
