"""The documents name files and pages that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PLACES = (ROOT / "src" / "mrgs", ROOT, ROOT / "tools")
DECISIONS = ROOT / "docs" / "decisions"
"""A decision may name a file that has left the code since; then it names the commit as well."""


def named_files(text: str) -> list[str]:
    """Paths of Python files in backticks, such as ``field/heat.py``."""
    return re.findall(r"`([\w/.]+\.py)\b", text)


def linked_files(text: str) -> list[str]:
    """Relative targets of links, without their anchors."""
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    return [target for target in targets if not re.match(r"[a-z]+:", target)]


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


def test_the_checks_can_fail():
    text = "See `field/nowhere.py` and [the page](lost.md#part), but not [the web](https://a.b/c)."
    assert named_files(text) == ["field/nowhere.py"]
    assert linked_files(text) == ["lost.md"]
