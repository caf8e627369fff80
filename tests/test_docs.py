"""The documents name files and pages that exist, their lines fit, and their tables are tables."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "plugins").glob("*/README.md")),
]
PLACES = (ROOT / "src" / "mrgs", ROOT, ROOT / "tools", *(ROOT / "plugins").iterdir())
DECISIONS = ROOT / "docs" / "decisions"
"""A decision may name a file that has left the code since; then it names the commit as well."""

WIDTH = 100
"""Of prose; tables, code and pictures may be wider."""


def named_files(text: str) -> list[str]:
    """Paths of Python files in backticks, such as ``field/heat.py``."""
    return re.findall(r"`([\w/.]+\.py)\b", text)


def linked_files(text: str) -> list[str]:
    """Relative targets of links, without their anchors."""
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    return [target for target in targets if not re.match(r"[a-z]+:", target)]


def without_code(text: str) -> Iterator[tuple[int, str]]:
    """Lines outside of fenced code, with their numbers from 1."""
    in_code = False
    for number, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith("```"):
            in_code = not in_code
        elif not in_code:
            yield number, line


def wide_lines(text: str) -> list[int]:
    """Numbers of the lines of prose that are too wide."""
    apart = ("|", "![", "    ")
    return [
        number
        for number, line in without_code(text)
        if len(line) > WIDTH and not line.startswith(apart)
    ]


def tables(text: str) -> Iterator[list[str]]:
    """Each run of lines that begin with a bar."""
    table: list[str] = []
    for _, line in [*without_code(text), (0, "")]:
        if line.startswith("|"):
            table.append(line)
        elif table:
            yield table
            table = []


def is_table(rows: list[str]) -> bool:
    """Whether there are a header, a line below it, and the same number of cells in each row."""
    cells = {len(re.findall(r"(?<!\\)\|", row)) for row in rows}
    return len(rows) > 1 and re.fullmatch(r"[|: -]+", rows[1]) is not None and len(cells) == 1


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(document):
    lost = [
        target
        for target in linked_files(document.read_text(encoding="utf-8"))
        if not (document.parent / target).exists()
    ]
    assert lost == []


@pytest.mark.parametrize(
    "document",
    [path for path in DOCUMENTS if path.parent != DECISIONS],
    ids=lambda path: path.relative_to(ROOT).as_posix(),
)
def test_named_files_exist(document):
    lost = [
        name
        for name in named_files(document.read_text(encoding="utf-8"))
        if not any((place / name).exists() for place in PLACES)
    ]
    assert lost == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_prose_is_not_too_wide(document):
    assert wide_lines(document.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_tables_are_tables(document):
    broken = [
        rows[0] for rows in tables(document.read_text(encoding="utf-8")) if not is_table(rows)
    ]
    assert broken == []


def test_the_index_lists_every_decision():
    index = " ".join((DECISIONS / "README.md").read_text(encoding="utf-8").split())
    lost = []
    for page in sorted(DECISIONS.glob("0*.md")):
        title = page.read_text(encoding="utf-8").splitlines()[0]
        number, _, name = title.removeprefix("# ").partition(": ")
        if f"- [{number}]({page.name}): {name}" not in index:
            lost.append(page.name)
    assert lost == []


def test_the_checks_can_fail():
    text = "See `field/nowhere.py` and [the page](lost.md#part), but not [the web](https://a.b/c)."
    assert named_files(text) == ["field/nowhere.py"]
    assert linked_files(text) == ["lost.md"]
    assert wide_lines("short\n" + "long " * 30 + "\n| " + "cell " * 30) == [2]
    assert wide_lines("```\n" + "code " * 30 + "\n```\n" + "long " * 30) == [4]
    whole, *cut = tables("| a | b |\n|---|---|\n| 1 | 2 |\n\n| 3 | 4 |\n\n| 5 |\n|---|\n| 6 | 7 |")
    assert is_table(whole)
    assert [is_table(rows) for rows in cut] == [False, False]
