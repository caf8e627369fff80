"""Everything that the report says has a translation in each language."""

from __future__ import annotations

import ast
import re
from datetime import date
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import get_args

import pytest

import mrgs
from mrgs.evaluation.report import COLUMNS
from mrgs.marks.emissivity import CaptureSettings
from mrgs.marks.mark import KINDS
from mrgs.marks.measure import (
    NARROW_COLD,
    NARROW_HOT,
    NO_PHOTO,
    NO_SURFACE,
    NO_THERMAL,
    SEVERAL_SURFACES,
)
from mrgs.marks.tables import PART_NAMES
from mrgs.marks.uncertainty import Budget
from mrgs.pictures.settings import SETTINGS
from mrgs.report.changes import HEADINGS, ChangeKind
from mrgs.report.modules import PARTS, SPOTS
from mrgs.report.sections import conditions_of
from mrgs.report.texts import LANGUAGES, Texts, catalogue
from mrgs.survey import LABELS, Side, Survey
from mrgs.system.wording import Message

TRANSLATED = [language for language in LANGUAGES if language != "en"]


def said() -> set[str]:
    """The sentences of the template, and those that reach it from the code."""
    sources = [
        files("mrgs").joinpath(f"report/{name}").read_text(encoding="utf-8")
        for name in (
            "report.html",
            "findings.py",
            "sections.py",
            "write.py",
            "diff.html",
            "changes.py",
            "modules.html",
            "modules.py",
        )
    ]
    joined = re.sub(r'"\n\s+"', "", re.sub(r't\(\n\s+"', 't("', "".join(sources)))
    conditions = [
        row
        for name in ("EN 13187", "IEC TS 62446-3")
        for row in conditions_of(Survey(standard=name))
    ]
    return {
        *re.findall(r'\bt\("([^"]+)"', joined),
        *(label for label, *_ in SETTINGS.values()),
        *(title for title, _ in COLUMNS.values()),
        *get_args(Side),
        *(label for label, _ in LABELS.values()),
        *(text for row in conditions for text in (row.what, row.asked)),
        *PART_NAMES.values(),
        *HEADINGS,
        *get_args(ChangeKind),
        *filter(None, (*PARTS, *SPOTS)),
        *KINDS,
    }


@pytest.mark.parametrize("language", TRANSLATED)
def test_every_sentence_is_translated_with_its_values(language):
    sentences = catalogue(language)
    assert said() - sentences.keys() == set()
    for english, translated in sentences.items():
        assert sorted(re.findall(r"{\w+}", english)) == sorted(re.findall(r"{\w+}", translated))


def test_numbers_are_written_as_the_language_does():
    assert Texts("de").number("−3.5") == "−3,5"
    assert Texts("de").number("-3.5 °C, 12.01.") == "−3,5 °C, 12,01."
    assert Texts().number("-3.5") == "−3.5"
    assert [Texts(each).decimal for each in LANGUAGES] == [".", ",", ","]
    assert [Texts(each).count(12_345) for each in LANGUAGES] == ["12,345", "12.345", "12\u202f345"]
    assert Texts("de").numbers("2.82, −4.45, 0.88") == "2,82; −4,45; 0,88"
    assert Texts().numbers("2.82, −4.45") == "2.82, −4.45"
    assert Texts("de").date(date(2026, 1, 12)) == "12.01.2026"
    assert Texts("fr")("{low} to {high}", low=1, high=2) == "1 à 2"
    named = Message("{name}: {value}K", name="Wall 1.5", value="1.5")
    assert Texts("de")(named) == "Wall 1.5: 1,5K"
    assert Texts("de")("unheard of") == "unheard of"


def test_hyphens_within_names_are_no_minus_signs():
    assert Texts().number("62446-3, S-1: -3.5") == "62446-3, S-1: −3.5"


def test_a_message_is_said_with_its_values():
    english = Message("{size} scene units²", size="3.17")
    assert english == "3.17 scene units²"
    assert Texts()(english) == english
    for language in TRANSLATED:
        number, unit = Texts(language)(english).split(maxsplit=1)
        assert number == "3,17"
        assert unit not in english
    unknown = Message("{name} unheard of", name="{S1}")
    assert Texts("de")(unknown) == unknown == "{S1} unheard of"


@cache
def templates() -> set[str]:
    """The messages of the whole program, as far as they are written out."""
    sources = [path.read_text(encoding="utf-8") for path in Path(mrgs.__path__[0]).rglob("*.py")]
    trees = [ast.parse(source) for source in sources if "Message(" in source]
    calls = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Call)]
    named = [call for call in calls if getattr(call.func, "id", "") == "Message"]
    firsts = [call.args[0] for call in named]
    return {first.value for first in firsts if isinstance(first, ast.Constant)}


def test_every_message_is_translated():
    assert len(templates()) >= 8
    for language in TRANSLATED:
        assert templates() - catalogue(language).keys() == set()


def test_what_marks_may_say_is_translated():
    said = [
        *CaptureSettings.of(None).notes,
        *Budget.of(None, Survey()).notes,
        NO_SURFACE,
        NO_PHOTO,
        NO_THERMAL,
        NARROW_HOT,
        NARROW_COLD,
        SEVERAL_SURFACES,
    ]
    for language in TRANSLATED:
        t = Texts(language)
        assert not [each for each in said if t(each) == each]
