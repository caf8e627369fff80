"""The report's sentences in other languages."""

from __future__ import annotations

import json
import re
from datetime import date
from functools import cache
from importlib.resources import files
from typing import Literal, get_args

from mrgs.system.wording import Message

Language = Literal["en", "de", "fr"]
LANGUAGES: tuple[Language, ...] = get_args(Language)

DECIMAL_COMMA: tuple[Language, ...] = ("de", "fr")
THOUSANDS: dict[Language, str] = {"en": ",", "de": ".", "fr": "\u202f"}
DATES: dict[Language, str] = {"en": "%Y-%m-%d", "de": "%d.%m.%Y", "fr": "%d/%m/%Y"}


class Texts:
    """Translates the report's sentences; a sentence without a translation in
    ``report/languages/LANGUAGE.json``, where they are under the English ones, stays English."""

    def __init__(self, language: Language = "en") -> None:
        self.language = language
        self._sentences = {} if language == "en" else catalogue(language)

    def __call__(self, english: str, **values: object) -> str:
        """A sentence, with values in place of ``{name}``; a ``Message`` has its own,
        of which ``name`` is what the user called something, and stays as it is."""
        if isinstance(english, Message):
            own = {
                name: text if name == "name" else self.number(text)
                for name, text in english.values.items()
            }
            english, values = english.template, {**own, **values}
        sentence = self._sentences.get(" ".join(english.split()), english)
        return sentence.format(**values) if values else sentence

    @property
    def decimal(self) -> str:
        """What the language writes before a number's decimals."""
        return "," if self.language in DECIMAL_COMMA else "."

    def number(self, text: str) -> str:
        """A formatted number as the language writes it, with a proper minus sign."""
        text = re.sub(r"(?<!\w)-(?=\d)", "−", text)
        return re.sub(r"(?<=\d)\.(?=\d)", self.decimal, text)

    def numbers(self, text: str) -> str:
        """Formatted numbers with a comma between them, as the language lists them."""
        return self.number(text if self.decimal == "." else text.replace(", ", "; "))

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
