"""A photo of a folder, and its camera and time from the names of its file and folders."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from mrgs.data.files import composed
from mrgs.data.radiometric import ExifFacts
from mrgs.data.radiometric.read import Kind
from mrgs.scene import RGB, THERMAL, Modality

REFERENCE, PARTNER = THERMAL, RGB
"""Every pair has a photo of the reference modality; its partner may be missing."""

_THERMAL_WORDS = {
    "thermal", "therm", "thrm", "thermo", "thermogram", "thermograms", "thermography",
    "radiometric", "ir", "irx", "tir", "lwir", "infrared", "temperature", "temperatures",
    "celsius", "8b", "thr",
}  # fmt: skip
_RGB_WORDS = {
    "rgb", "vis", "visible", "visual", "color", "colour", "dc", "eo", "wide", "zoom", "scrn",
    "max", "optical", "vl",
}  # fmt: skip
_WORDS = {THERMAL: _THERMAL_WORDS, RGB: _RGB_WORDS}
_PHOTO_WORDS = {"image", "images", "photo", "photos"}
"""Folders with these names hold RGB photos, unless something else in the name says thermal."""

_FILLERS = {
    "image", "img", "photo", "picture", "value", "values", "data", "raw",
    "temp", "temps", "tiff", "csv", "npy", "16bit", "color", "colour",
}  # fmt: skip
"""Words that may follow a camera suffix at the end of a name: ``IR_0001_rgb_image``."""

HEADINGS = {
    RGB: {"rgb", "visible", "vis", "visual", "optical", "color", "colour", "image"},
    THERMAL: {"thermal", "ir", "tir", "infrared"},
}
"""Words in the headings of the columns in a table of pairs; the thermal ones count first."""

_LETTERS = {"t": THERMAL, **dict.fromkeys("wvzs", RGB)}
"""The last letter of DJI's names: thermal, wide, visible, zoom, screenshot."""

PARTNER_MARKS = (
    "w", "wide", "v", "vis", "visible", "visual", "rgb", "dc", "eo", "vl", "optical", "", "z",
    "zoom",
)  # fmt: skip
"""Camera suffixes by preference among RGB photos of a moment: wide ones cover the thermal image."""

_LAST_LETTER = re.compile(
    r"(?:(?<=\d)(?!(?<=T\d{6})z$)[_\-]?(?P<camera>[twvzs])|[_\-](?P<thermal>t))$", re.IGNORECASE
)
"""After a number any of these letters, but for the Z of ``20240131T120000Z``; after a word only T:
``house_w`` may be the west side."""

_BEHIND_T = re.compile(rf"(?i)(?<=\d[_\-]t)[_\-](?:{'|'.join(_FILLERS | _THERMAL_WORDS)})$")
"""What was made from a thermal photo of DJI's: ``DJI_0001_T_celsius``."""

_LAST_R = re.compile(r"(?:(?<=\d)[_\-]r|[_\-]rad)$", re.IGNORECASE)
_STAMPED = re.compile(r"(.*?)(\d{14})[_\-](\d{3,6})[_\-]([a-z]+)(?:[_\-](.*))?", re.IGNORECASE)
"""DJI's newer names: ``DJI_20240131120000_0001_T_Waypoint1``."""

_PREFERENCE: tuple[Kind, ...] = ("signal", "numbers", "table", "image")
"""Kinds in order of preference where several files show the same."""

_RESERVED = {"con", "prn", "aux", "nul", *(f"{p}{n}" for p in ("com", "lpt") for n in range(10))}
_LONGEST_NAME = 100


@dataclass(frozen=True)
class Photo:
    """A file that can be a photo of a pair; None where its header does not say.

    Attributes:
        origin: path of the camera's original file without the extension, relative to the folder of
            photos.
        size: width and height in pixels.
        needs_tool: whether only the maker's tool reads it.
        embedded: whether a photo in visible light is inside.
        focal_mm: focal length in mm.
        field_of_view_deg: horizontal, of the thermal camera's lens.
        serial: the camera's serial number.
        name: the path below the folder of photos, for messages.
        is_reference: whether it is of the reference modality: by content, else by the folder, else
            by the name; see ``told_apart``.
    """

    path: Path
    origin: PurePosixPath
    kind: Kind
    size: tuple[int, int] | None = None
    needs_tool: bool = False
    embedded: bool = False
    exif: ExifFacts = field(default_factory=ExifFacts)
    focal_mm: float | None = None
    field_of_view_deg: float | None = None
    serial: str | None = None
    name: str = ""
    is_reference: bool = False

    @property
    def is_thermal(self) -> bool:
        """Whether the content is thermal for certain; a plain image may be thermal as well."""
        return self.kind != "image"

    @property
    def preference(self) -> int:
        """Lower is better, where several files show the same."""
        return len(_PREFERENCE) if self.needs_tool else _PREFERENCE.index(self.kind)


@dataclass(frozen=True)
class StemFacts:
    """Facts in the stem of a file's name: the stem without camera suffix and time; the modality by
    the camera suffix; that suffix in lower case; and the time."""

    key: str
    modality: Modality | None = None
    mark: str = ""
    moment: datetime | None = None


def read_stem(stem: str, radiometric: bool = False) -> StemFacts:
    """The facts in a stem. If the file is ``radiometric``, thermal by content, then an ``_R`` or
    ``_RAD`` at the end marks it as thermal, too (FLIR Duo, DJI XT2, Workswell)."""
    stem = _BEHIND_T.sub("", stem)
    if radiometric and (found := _LAST_R.search(stem)):
        return StemFacts(stem[: found.start()], THERMAL, "r")
    if (found := _STAMPED.fullmatch(stem)) and (modality := _modality_of(found[4])) is not None:
        stripped = (part.strip("_-") for part in (found[1], found[3], found[5] or ""))
        key = "_".join(part for part in stripped if part)
        return StemFacts(key, modality, found[4].lower(), _moment(found[2]))
    if found := _LAST_LETTER.search(stem):
        mark = (found["camera"] or found["thermal"]).lower()
        return StemFacts(stem[: found.start()], _LETTERS[mark], mark)
    parts = re.split(r"[_\-. ]+", stem)
    named = [_word_and_number(part) for part in parts]
    for index in reversed(range(len(parts))):
        mark = named[index][0].lower()
        modality = _modality_of(mark) if len(mark) > 1 else None
        if mark in _FILLERS and index and named[index - 1][0].lower() in _THERMAL_WORDS:
            continue  # 0001_thermal_color is in false colours
        if modality is not None:
            # IR0001_visible belongs to IR0001, 0001_ir_celsius to 0001_rgb, and Autel's
            # MAX_0001_IR to MAX_0001.
            fillers = {part.lower() for part in parts[index + 1 :]}
            rest = [
                number if at == index or word.lower() in {*_THERMAL_WORDS, "max"} else parts[at]
                for at, (word, number) in enumerate(named)
                if at <= index or not fillers <= _FILLERS
            ]
            return StemFacts("_".join(filter(None, rest)), modality, mark)
    return StemFacts(stem)


def _word_and_number(part: str) -> tuple[str, str]:
    """``ir0001`` and ``0001ir`` are a word and a number; any other part is a word."""
    found = re.fullmatch(r"([A-Za-z]+)([0-9]+)|([0-9]+)([A-Za-z]+)", part)
    if part.lower() in _WORDS[THERMAL] or found is None:
        return part, ""
    return found[1] or found[4], found[2] or found[3]


def _modality_of(word: str) -> Modality | None:
    word = word.lower()
    return next((each for each, words in _WORDS.items() if word in words), _LETTERS.get(word))


def _moment(digits: str) -> datetime | None:
    try:
        return datetime.strptime(digits, "%Y%m%d%H%M%S")
    except ValueError:
        return None


def folder_modality(
    folders: Sequence[str], with_rest: bool = True
) -> tuple[Modality | None, tuple[str, ...]]:
    """The modality that the innermost folder named after one has, and the folders without these
    words: ``roof_rgb`` becomes ``roof``, and ``rgb`` goes; both go if not ``with_rest``."""
    for index in reversed(range(len(folders))):
        words = [word.lower() for word in re.findall(r"[A-Za-z]+|[0-9]+", folders[index])]
        named = [modality for modality, own in _WORDS.items() if own.intersection(words)]
        if not named:
            # FLIR's cameras put all their photos into 100_FLIR; a folder of that name alone was
            # made by the user.
            is_photos = not _PHOTO_WORDS.isdisjoint(words)
            named = [THERMAL] if words == ["flir"] else [RGB] if is_photos else []
        if len(named) == 1:
            idle = {"flir"} | _WORDS[named[0]] | _PHOTO_WORDS | _FILLERS
            rest = "_".join(word for word in words if word not in idle)
            kept = [rest] if rest and with_rest else []
            return named[0], (*folders[:index], *kept, *folders[index + 1 :])
    return None, tuple(folders)


class Candidate(NamedTuple):
    """A photo with the facts in its name; photos of one moment have the same key."""

    photo: Photo
    modality: Modality | None
    key: str
    mark: str
    moment: datetime | None

    @property
    def is_reference(self) -> bool:
        """Whether the photo is known to be of the reference modality."""
        return self.modality == REFERENCE


def candidate_by_name(photo: Photo, folders: Sequence[str] | None = None) -> Candidate:
    """Modality by content and file name; the folder is part of the key, or ``folders`` are."""
    folders = photo.origin.parts[:-1] if folders is None else folders
    facts = read_stem(photo.origin.name, photo.is_thermal)
    key = composed("/".join([*folders, facts.key]).casefold())
    modality = REFERENCE if photo.is_thermal else facts.modality
    return Candidate(photo, modality, key, facts.mark, facts.moment)


def candidate_by_folder(photo: Photo, with_rest: bool = True) -> Candidate:
    """Modality by content and folder, else as ``told_apart``. Of the folder named after a modality
    the rest of its name is part of the key, or nothing."""
    named, folders = folder_modality(photo.origin.parts[:-1], with_rest)
    is_reference = photo.is_thermal or (named is None and photo.is_reference)
    modality = REFERENCE if is_reference else named
    return candidate_by_name(photo, folders)._replace(modality=modality)


def told_apart(photos: Sequence[Photo], root_name: str) -> list[Photo]:
    """The photos, which know if they are of the reference modality. The name of the folder of all
    photos counts where nothing else says what any of them is: a folder of both cameras' photos may
    be called "thermal survey", and so may one below it: half as many plain images or more, whose
    names do not begin like theirs, are RGB photos there unless their names say something else."""
    certain = [photo for photo in photos if photo.is_thermal]
    stems = {str(photo.origin) for photo in certain}
    others = [photo for photo in photos if not _begins_with_one_of(str(photo.origin), stems)]
    thermal, plain = (
        Counter(photo.origin.parent for photo in group) for group in (certain, others)
    )
    # A folder called RGB has the RGB photos, and a table beside many images may describe them.
    rgb = {at for at in plain if folder_modality(at.parts)[0] == PARTNER}
    alone = {at for at in plain if rgb <= {at}}
    mixed = {at for at in alone if 0 < thermal[at] <= 2 * plain[at] <= 8 * thermal[at]}
    if not rgb:  # names of both cameras go before the folder's
        marked = [(one.origin.parent, read_stem(one.origin.name, one.is_thermal)) for one in photos]
        names = {(at, facts.modality) for at, facts in marked if facts.mark not in _FILLERS}
        mixed |= {at for at, _ in names if {(at, each) for each in _WORDS} <= names}
    not_by_folder = {photo for photo in others if photo.origin.parent in mixed}
    found = [
        (None if photo in not_by_folder else candidate_by_folder(photo).modality)
        or candidate_by_name(photo).modality
        for photo in photos
    ]
    if not any(found):
        found = [folder_modality([root_name])[0]] * len(photos)
    return [
        replace(photo, is_reference=modality == REFERENCE)
        for photo, modality in zip(photos, found, strict=True)
    ]


def _begins_with_one_of(text: str, beginnings: set[str]) -> bool:
    """Whether it is one of them, or goes on with something else than a letter or a digit."""
    ends = (at for at in range(1, len(text) + 1) if not text[at : at + 1].isalnum())
    return any(text[:end] in beginnings for end in ends)


def natural(text: str) -> tuple[list[tuple[int, int, str]], str]:
    """A sort key: numbers by their value, letters without their case."""
    parts = [part for part in re.split(r"([0-9]+)", text) if part]
    key = [
        (0, int(part), "") if part[0] in "0123456789" else (1, 0, part.casefold()) for part in parts
    ]
    return key, text


def view_names(paths: Sequence[PurePosixPath]) -> list[str]:
    """Names of views: short, unique even where case is ignored, and valid file stems on every
    system. Folders are part of a name only where two names would be equal. ``paths`` are those of
    the photos, relative to their folder, without extension."""
    short = [_safe(path.name) for path in paths]
    long = [_safe("_".join(path.parts)) for path in paths]
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
