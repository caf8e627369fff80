"""The report's sentences in other languages."""

from __future__ import annotations

import json
import re
from datetime import date
from functools import cache
from importlib.resources import files
from typing import Literal, get_args

Language = Literal["en", "de", "fr"]
LANGUAGES: tuple[Language, ...] = get_args(Language)

DECIMAL_COMMA: tuple[Language, ...] = ("de", "fr")
THOUSANDS: dict[Language, str] = {"en": ",", "de": ".", "fr": "\u202f"}
DATES: dict[Language, str] = {"en": "%Y-%m-%d", "de": "%d.%m.%Y", "fr": "%d/%m/%Y"}


FEWEST_LETTERS = 12
"""Beside the values of a sentence, for it to be known by them."""


class Texts:
    """Translates what the report says; a sentence without a translation stays English.

    Args:
        language: of the report; its sentences are in ``report/languages/LANGUAGE.json``, under the
            English ones.
    """

    def __init__(self, language: Language = "en") -> None:
        self.language = language
        self._sentences = {} if language == "en" else catalogue(language)

    def __call__(self, english: str, **values: object) -> str:
        """A sentence, with values in place of ``{name}``.

        One that holds its values already is found by the words between them.
        """
        key = " ".join(english.split())
        if not values and key not in self._sentences:
            return self._by_pattern(key) or english
        sentence = self._sentences.get(key, english)
        return sentence.format(**values) if values else sentence

    def _by_pattern(self, english: str) -> str | None:
        for pattern, key in patterns(self.language):
            if found := pattern.fullmatch(english):
                values = {name: self.number(text) for name, text in found.groupdict().items()}
                return self._sentences[key].format(**values)
        return None

    def number(self, text: str) -> str:
        """A formatted number as the language writes it, with a proper minus sign."""
        text = re.sub(r"(?<!\w)-(?=\d)", "−", text)
        if self.language not in DECIMAL_COMMA:
            return text
        return re.sub(r"(?<=\d)\.(?=\d)", ",", text)

    def count(self, number: int) -> str:
        """A whole number with its thousands apart."""
        return f"{number:,}".replace(",", THOUSANDS[self.language])

    def date(self, day: date) -> str:
        """A day in figures."""
        return day.strftime(DATES[self.language])


@cache
def catalogue(language: Language) -> dict[str, str]:
    """The sentences of a language by the English ones."""
    path = files("mrgs").joinpath(f"report/languages/{language}.json")
    sentences: dict[str, str] = json.loads(path.read_text(encoding="utf-8"))
    return sentences


@cache
def patterns(language: Language) -> list[tuple[re.Pattern[str], str]]:
    """English sentences with values, and what finds them when their values are filled in."""
    if language == "en":
        return []
    return [
        (re.compile(re.sub(r"\\{(\w+)\\}", r"(?P<\1>.+?)", re.escape(key))), key)
        for key in catalogue(language)
        if "{" in key and len(re.sub(r"{\w+}", "", key)) >= FEWEST_LETTERS
    ]
