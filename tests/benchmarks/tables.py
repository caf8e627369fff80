"""Tables of Markdown, read back."""

from __future__ import annotations


def rows(markdown: str) -> list[list[str]]:
    """The cells of every row, those of headers and their rules among them."""
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
