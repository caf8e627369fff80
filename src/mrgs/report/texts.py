"""The report's sentences in other languages."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Literal, get_args

Language = Literal["en", "de", "fr"]
LANGUAGES: tuple[Language, ...] = get_args(Language)

DECIMAL_COMMA: tuple[Language, ...] = ("de", "fr")


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
        """A sentence, with values in place of ``{name}``."""
        sentence = self._sentences.get(" ".join(english.split()), english)
        return sentence.format(**values) if values else sentence

    def number(self, text: str) -> str:
        """A formatted number as the language writes it."""
        return text.replace(".", ",") if self.language in DECIMAL_COMMA else text


@cache
def catalogue(language: Language) -> dict[str, str]:
    """The sentences of a language by the English ones."""
    path = files("mrgs").joinpath(f"report/languages/{language}.json")
    sentences: dict[str, str] = json.loads(path.read_text(encoding="utf-8"))
    return sentences
