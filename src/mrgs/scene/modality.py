"""What a model renders images of: colours, temperatures, or any other kind of radiation."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

from mrgs.system.typed_json import from_json

_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
LONGEST_TEXT = 40
"""Characters of a name, a unit or a title."""


@dataclass(frozen=True, order=True)
class Modality:
    """One kind of image. All modalities share the Gaussians' geometry; each has its own opacity and
    its own appearance.

    Views, photos, renderings, opacities and metrics are indexed by it. Two with the same name and
    channels are equal: unit and title only say how it is shown. ValueError for a name that is no
    lower-case identifier, no channel, or a text that is too long or cannot be printed.

    Attributes:
        name: a lower-case identifier, unique; it is used in files, logs and the names of tensors.
        channels: values per pixel, at least 1.
        unit: of the values once they are no longer normalised ("°C"); None for plain intensities in
            [0, 1].
        title: what headings and legends call it; the name if empty.
    """

    name: str
    channels: int
    unit: str | None = field(default=None, compare=False)
    title: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(
                f"a modality's name must be a lower-case identifier: {self.name[:LONGEST_TEXT]!r}"
            )
        if self.channels < 1:
            raise ValueError(f"modality {self.name} needs at least one channel")
        if not self.title:
            object.__setattr__(self, "title", self.name)
        for text in (self.name, self.unit or "", self.title):
            if len(text) > LONGEST_TEXT or not text.isprintable():
                raise ValueError(
                    f"texts of modality {self.name[:LONGEST_TEXT]} must be printable and of at "
                    f"most {LONGEST_TEXT} characters: {text[:LONGEST_TEXT]!r}"
                )

    def __str__(self) -> str:
        return self.name

    @property
    def is_metric(self) -> bool:
        """Whether the values measure a quantity in a unit; else they are shown as intensities."""
        return self.unit is not None and self.channels == 1

    @property
    def quantity(self) -> str:
        """What the values are, as a word within a sentence: "colour" or "temperature"; the title of
        any other modality."""
        return _QUANTITIES.get(self.name, self.title)

    def to_json(self) -> dict[str, Any]:
        """Name, channels, unit and title as a JSON object; ``from_json`` reads it."""
        return asdict(self)

    @classmethod
    def from_json(cls, value: object) -> Modality:
        """A modality from a JSON object with ``name`` and ``channels``; ``unit`` and ``title`` may
        be left out. ValueError for any other value."""
        try:
            return from_json(cls, value)
        except ValueError as error:
            raise ValueError(f"this is not a modality: {error}") from None


RGB = Modality("rgb", 3, title="RGB")
"""Colours in [0, 1]."""

THERMAL = Modality("thermal", 1, unit="°C")
"""Temperatures, normalised by the scene's ``TemperatureRange``."""

BUILT_IN = (RGB, THERMAL)
"""Known to every reader, in the order in which views list them."""

_QUANTITIES = {RGB.name: "colour", THERMAL.name: "temperature"}

_known: dict[str, Modality] = {modality.name: modality for modality in BUILT_IN}


def register_modality(modality: Modality) -> Modality:
    """Make a modality known to the readers of all scenes, like one that ``transforms.json`` lists
    under ``modalities``; returns it. Frames may then have ``NAME_file_path``; its images are
    trained, scored, rendered and exported like all others. May be repeated. ValueError if a
    modality of this name has another number of channels."""
    known = _known.setdefault(modality.name, modality)
    if known != modality:
        raise ValueError(
            f"there is another modality {modality.name!r}, of {known.channels} channels"
        )
    return modality


def known_modalities() -> tuple[Modality, ...]:
    """RGB, thermal, and all registered ones in the order of their registration."""
    return tuple(_known.values())


def in_order(modalities: Iterable[Modality]) -> tuple[Modality, ...]:
    """Each modality once: RGB first, thermal second, the others by name."""
    found = set(modalities)
    built_in = [modality for modality in BUILT_IN if modality in found]
    return (*built_in, *sorted(found - set(built_in)))


def metric_first(modalities: Iterable[Modality]) -> tuple[Modality, ...]:
    """Modalities of a quantity in a unit, then intensities; each group in its order."""
    return tuple(sorted(modalities, key=lambda modality: not modality.is_metric))


def modality_named(name: str) -> Modality:
    """The known modality of a name. ValueError if there is none."""
    if name not in _known:
        raise ValueError(f"unknown modality {name!r}; known are {', '.join(_known)}")
    return _known[name]
