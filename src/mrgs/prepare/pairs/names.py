"""What the names of files and folders say: which camera took a photo, and at which moment."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import PurePosixPath
from typing import Literal

Role = Literal["rgb", "thermal"]

_THERMAL = {
    "thermal", "therm", "thrm", "thermo", "thermogram", "thermograms", "thermography",
    "radiometric", "ir", "irx", "tir", "lwir", "infrared", "temperature", "temperatures",
    "celsius", "8b",
}  # fmt: skip
_RGB = {
    "rgb", "vis", "visible", "visual", "color", "colour", "dc", "eo", "wide", "zoom", "scrn",
    "max", "optical",
}  # fmt: skip
_RGB_FOLDER = {"image", "images", "photo", "photos"}
"""Names of folders that are RGB's only if nothing in them says thermal."""

_LETTERS: dict[str, Role] = {"t": "thermal", "w": "rgb", "v": "rgb", "z": "rgb", "s": "rgb"}
"""The last letter of DJI's names: thermal, wide, visible, zoom, screenshot."""

RGB_MARKS = ("w", "wide", "v", "vis", "visible", "rgb", "", "z", "zoom")
"""Camera suffixes by preference among RGB photos of one moment; a wide view covers the thermal
one."""

_LAST_LETTER = re.compile(
    r"(?:(?<=\d)[_\-]?(?P<camera>[twvzs])|[_\-](?P<thermal>t))$", re.IGNORECASE
)
"""After a number any of these letters; after a word only the T: ``house_w`` may well be the west
side."""

_LAST_R = re.compile(r"(?<=\d)[_\-]r$", re.IGNORECASE)
_STAMPED = re.compile(r"(.*?)(\d{14})[_\-](\d{3,6})[_\-]([a-z]+)(?:[_\-](.*))?", re.IGNORECASE)
"""DJI's newer names: ``DJI_20240131120000_0001_T_Waypoint1``."""

_RESERVED = {"con", "prn", "aux", "nul", *(f"{p}{n}" for p in ("com", "lpt") for n in range(10))}
_LONGEST_NAME = 100


@dataclass(frozen=True)
class StemFacts:
    """What the stem of a file's name says.

    Attributes:
        key: the stem without camera suffix and time.
        role: by the camera suffix; None without one.
        mark: the camera suffix in lower case; empty without one.
        moment: the time in the name; None without one.
    """

    key: str
    role: Role | None = None
    mark: str = ""
    moment: datetime | None = None


def composed(text: str) -> str:
    """The text in one Unicode form (NFC): macOS may write ``ü`` as two characters, where other
    systems write one."""
    return unicodedata.normalize("NFC", text)


def printable(name: str) -> str:
    """The name of a file for messages: bytes that are not UTF-8 can be neither shown nor saved."""
    return os.fsencode(name).decode("utf-8", "replace")


def read_stem(stem: str, radiometric: bool = False) -> StemFacts:
    """The facts in a stem.

    Args:
        stem: of a file's name.
        radiometric: whether the file is thermal by content: then an ``_R`` at the end says so, too
            (FLIR Duo, DJI XT2).
    """
    if radiometric and (found := _LAST_R.search(stem)):
        return StemFacts(stem[: found.start()], "thermal", "r")
    if (found := _STAMPED.fullmatch(stem)) and (role := _role_of_word(found[4])) is not None:
        return StemFacts(
            _joined(found[1], found[3], found[5] or ""), role, found[4].lower(), _moment(found[2])
        )
    if found := _LAST_LETTER.search(stem):
        mark = (found["camera"] or found["thermal"]).lower()
        return StemFacts(stem[: found.start()], _LETTERS[mark], mark)
    return _by_words(stem)


def _by_words(stem: str) -> StemFacts:
    parts = re.split(r"[_\-. ]+", stem)
    for index in reversed(range(len(parts))):
        word, number = _word_and_number(parts[index])
        role = _role_of_word(word) if len(word) > 1 else None
        if role is not None:
            rest = [*parts[:index], number, *parts[index + 1 :]]
            return StemFacts("_".join(part for part in rest if part), role, word.lower())
    return StemFacts(stem)


def _word_and_number(part: str) -> tuple[str, str]:
    """``ir0001`` and ``0001ir`` hold a word and a number; any other part is taken for a word."""
    if part.lower() in _THERMAL:
        return part, ""
    if found := re.fullmatch(r"([A-Za-z]+)([0-9]+)", part):
        return found[1], found[2]
    if found := re.fullmatch(r"([0-9]+)([A-Za-z]+)", part):
        return found[2], found[1]
    return part, ""


def _role_of_word(word: str) -> Role | None:
    word = word.lower()
    if word in _THERMAL:
        return "thermal"
    return "rgb" if word in _RGB else _LETTERS.get(word)


def _moment(digits: str) -> datetime | None:
    try:
        return datetime.strptime(digits, "%Y%m%d%H%M%S")
    except ValueError:
        return None


def _joined(*parts: str) -> str:
    return "_".join(stripped for part in parts if (stripped := part.strip("_-")))


def folder_role(folders: Sequence[str]) -> tuple[Role | None, tuple[str, ...]]:
    """The camera that the innermost folder with such a name says, and the folders without it."""
    for index in reversed(range(len(folders))):
        words = {word.lower() for word in re.findall(r"[A-Za-z]+|[0-9]+", folders[index])}
        thermal, rgb = bool(words & _THERMAL), bool(words & _RGB)
        if not thermal and not rgb:
            # FLIR's cameras put all their photos into 100_FLIR; a folder of that name alone was
            # made by the user.
            thermal, rgb = words == {"flir"}, bool(words & _RGB_FOLDER)
        if thermal != rgb:
            return ("thermal" if thermal else "rgb"), (*folders[:index], *folders[index + 1 :])
    return None, tuple(folders)


def natural(text: str) -> tuple[list[tuple[int, int, str]], str]:
    """A key to sort by: numbers by their value, letters without their case."""
    parts = [part for part in re.split(r"([0-9]+)", text) if part]
    key = [
        (0, int(part), "") if part[0] in "0123456789" else (1, 0, part.casefold()) for part in parts
    ]
    return key, text


def view_names(shots: Sequence[PurePosixPath]) -> list[str]:
    """Names of views: short, unique even where upper and lower case are one, and valid files' stems
    on every system.

    The folders are part of a name only where two shots would be called the same.
    """
    short = [_safe(shot.name) for shot in shots]
    long = [_safe("_".join(shot.parts)) for shot in shots]
    counts = Counter(name.lower() for name in short)
    taken: set[str] = set()
    names = []
    for index, name in enumerate(short):
        if counts[name.lower()] > 1:
            name = long[index]
        chosen, number = name, 2
        while chosen.lower() in taken:
            chosen, number = f"{name}_{number}", number + 1
        taken.add(chosen.lower())
        names.append(chosen)
    return names


def _safe(text: str) -> str:
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", plain).strip("_-")[:_LONGEST_NAME] or "view"
    return f"{name}_" if name.lower() in _RESERVED else name
