"""The settings that the temperatures of a scene's photos were computed with, as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from mrgs.scene.radiometry import PhotoRecord
from mrgs.system.wording import number_text

SETTINGS = {
    "emissivity": ("emissivity", "", 2),
    "reflected_c": ("reflected temperature", " °C", 1),
    "distance_m": ("distance", " m", 1),
    "atmospheric_c": ("air temperature", " °C", 1),
    "humidity": ("relative humidity", "", 2),
    "window_c": ("window temperature", " °C", 1),
    "window_transmission": ("window transmission", "", 2),
}
"""Name in a text, unit behind a number, and decimals of each parameter of the measurement."""


class Setting(NamedTuple):
    """A parameter of the measurement over all photos: its smallest and largest value as texts,
    empty where no photo has one; the unit as written behind a number; whether the user gave it; and
    for how many photos it is missing."""

    label: str
    low: str
    high: str
    unit: str
    given: bool
    missing: int

    @property
    def differs(self) -> bool:
        """Whether the photos have several values."""
        return self.low != self.high

    @property
    def value(self) -> str:
        """The value, or the range of the photos' values, with the unit; empty if not known."""
        if not self.low:
            return ""
        return f"{self.low} to {self.high}{self.unit}" if self.differs else self.low + self.unit


def settings_of(records: Sequence[PhotoRecord]) -> dict[str, Setting]:
    """The settings by the names of ``SETTINGS``; a window's only where there is one."""
    found = {}
    for name, (label, unit, decimals) in SETTINGS.items():
        values = [value for record in records if (value := record.setting(name)) is not None]
        ends = (min(values), max(values)) if values else ()
        low, high = [number_text(value, decimals) for value in ends] or ("", "")
        given = any(name in record.given for record in records)
        found[name] = Setting(label, low, high, unit, given, len(records) - len(values))
    windows = [record.setting("window_transmission") for record in records]
    if all(value is None or value == 1 for value in windows):
        del found["window_c"], found["window_transmission"]
    return found


def settings_text(settings: Mapping[str, Setting], given: str) -> str:
    """The settings that are known, as part of a sentence; ``given`` is put behind the user's."""
    return ", ".join(
        f"{each.label} {each.value}{f' ({given})' if each.given else ''}"
        for each in settings.values()
        if each.value
    )
