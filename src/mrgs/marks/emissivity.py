"""Temperatures of a surface with another emissivity and another reflected temperature than the
photos were computed with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import median
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64

from mrgs.errors import ConfigError
from mrgs.marks.mark import Mark
from mrgs.scene import Scene
from mrgs.scene.radiometry import TYPICAL_LAW, TYPICAL_WAVELENGTH_UM, PhotoRecord, Planck, law_of
from mrgs.system.wording import Message

Values: TypeAlias = Float64[np.ndarray, "..."]


@dataclass(frozen=True)
class SurfaceSettings:
    """How a surface radiates: its emissivity, above 0 and at most 1, and the reflected apparent
    temperature, °C, None if not known, which an emissivity of 1 does not need."""

    emissivity: float
    reflected_c: float | None


@dataclass(frozen=True)
class CaptureSettings:
    """What the temperatures of a scene's photos were computed with: settings of the surface, the
    camera's calibration, and what was assumed, one sentence each."""

    surface: SurfaceSettings = SurfaceSettings(1.0, None)
    law: Planck = TYPICAL_LAW
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene | None) -> CaptureSettings:
        """The settings of a scene's thermal photos: their median where they differ."""
        records = [] if scene is None else scene.records
        surface, surface_notes = _surface_of(records)
        law, law_notes = _law_of(records)
        return cls(surface, law, (*surface_notes, *law_notes))

    def of_mark(self, mark: Mark) -> SurfaceSettings:
        """The settings of the surface in a mark: its own, else those of the photos. ConfigError if
        the reflected temperature is needed, and neither has one."""
        emissivity = self.surface.emissivity if mark.emissivity is None else mark.emissivity
        reflected = self.surface.reflected_c if mark.reflected_c is None else mark.reflected_c
        if emissivity < 1 and reflected is None:
            raise ConfigError(
                Message(
                    "{name}: the photos do not say the reflected temperature; give it too",
                    name=mark.name,
                )
            )
        return SurfaceSettings(emissivity, reflected)

    def corrected(self, celsius: Values, surface: SurfaceSettings) -> Values:
        """The temperatures of a surface with other settings, °C, from those that the photos give.

        What reaches the camera stays the same, W being the camera's signal of a black body:
        ε' W(T') + (1 − ε') W(T'_refl) = ε W(T) + (1 − ε) W(T_refl). Air and window weigh both sides
        alike. NaN where the reflection alone would be more than what was measured.
        """
        return self.celsius_of(self.received(celsius), surface)

    def as_photos(self, celsius: Values, surface: SurfaceSettings) -> Values:
        """Inverse of ``corrected``: what the photos give for temperatures of a surface."""
        there = replace(self, surface=surface)
        return self.celsius_of(there.received(celsius), self.surface)

    def received(self, celsius: Values) -> Values:
        """The signal that left a surface, from its temperatures in the photos, °C."""
        own: Values = self.law.signals(celsius) + self.law.o
        return self.surface.emissivity * own + self._reflected(self.surface)

    def celsius_of(self, received: Values, surface: SurfaceSettings) -> Values:
        """The temperatures, °C, of a surface that a signal left; NaN where there is none."""
        of_object = (received - self._reflected(surface)) / surface.emissivity
        celsius: Values = self.law.celsius(of_object - self.law.o)
        return celsius

    def signal_change(self, surface: SurfaceSettings) -> tuple[float, float]:
        """Gain and offset (counts) that turn a surface's own signal in the photos, ``law``'s plus
        ``law.o``, into that of ``corrected``."""
        difference = self._reflected(self.surface) - self._reflected(surface)
        return self.surface.emissivity / surface.emissivity, difference / surface.emissivity

    def _reflected(self, surface: SurfaceSettings) -> float:
        if surface.reflected_c is None:
            return 0.0
        return (1 - surface.emissivity) * (self.law.signal(surface.reflected_c) + self.law.o)


def _surface_of(records: list[PhotoRecord]) -> tuple[SurfaceSettings, list[str]]:
    known = [
        (emissivity, reflected_c)
        for record in records
        if (emissivity := record.setting("emissivity")) is not None
        and (reflected_c := record.setting("reflected_c")) is not None
    ]
    if not known:
        return SurfaceSettings(1.0, None), [
            "The photos do not say their emissivity: their temperatures are taken as apparent ones "
            "(emissivity 1). If the camera or a program has applied another, give it and the "
            "reflected temperature where the scene is prepared."
        ]
    emissivities, reflected = zip(*known, strict=True)
    differs = "Emissivity or reflected temperature differ between the photos: their median is used."
    same = np.ptp(emissivities) <= 1e-4 and np.ptp(reflected) <= 0.05
    settings = SurfaceSettings(median(emissivities), median(reflected))
    return settings, [] if same else [differs]


def _law_of(records: list[PhotoRecord]) -> tuple[Planck, list[str]]:
    if (law := law_of(records)) is not None:
        return law, []
    return TYPICAL_LAW, [
        Message(
            "The camera's constants are not known: its signal is taken as that of black bodies at "
            "{wavelength} µm.",
            wavelength=f"{TYPICAL_WAVELENGTH_UM:g}",
        )
    ]
