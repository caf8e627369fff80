"""Everything that the report says has a translation in each language."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

from mrgs.marks.texts import PART_NAMES
from mrgs.report.conditions import LABELS, conditions_of
from mrgs.report.texts import LANGUAGES, Texts, catalogue
from mrgs.survey import Survey

TRANSLATED = [language for language in LANGUAGES if language != "en"]


def said() -> set[str]:
    """The sentences of the template, and those that reach it from the code."""
    template = files("mrgs").joinpath("report/report.html").read_text(encoding="utf-8")
    conditions = [
        row
        for name in ("EN 13187", "IEC TS 62446-3")
        for row in conditions_of(Survey(standard=name))
    ]
    return {
        *re.findall(r't\("([^"]+)"', template),
        *(label for label, _ in LABELS.values()),
        *(text for row in conditions for text in (row.what, row.asked)),
        *PART_NAMES.values(),
    }


@pytest.mark.parametrize("language", TRANSLATED)
def test_every_sentence_is_translated_with_its_values(language):
    sentences = catalogue(language)
    assert said() - sentences.keys() == set()
    for english, translated in sentences.items():
        assert sorted(re.findall(r"{\w+}", english)) == sorted(re.findall(r"{\w+}", translated))


def test_numbers_are_written_as_the_language_does():
    assert Texts("de").number("−3.5") == "−3,5"
    assert Texts().number("−3.5") == "−3.5"
    assert Texts("fr")("{low} to {high}", low=1, high=2) == "1 à 2"
    assert Texts("de")("not a sentence of the report") == "not a sentence of the report"
