"""The parts of a temperature's uncertainty that photos and model tell by themselves.

The constants were set on generated scenes with exact temperatures, and checked on others: see
``docs/decisions/036-uncertainty.md``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

SHIFT_PX = 3


class Shares(NamedTuple):
    """How much of each part counts.

    Attributes:
        scatter: times the standard deviation of the photos' readings. It is not divided by the root
            of their number: what they disagree by at one place, a reflection or a wrong depth,
            their mean keeps.
        contrast: times the change of the model's value when the place is shifted by ``SHIFT_PX``:
            places and poses are not known better, and detail that fine is not resolved.
        blur: times what the camera's blur changes there: a peak that the photos show as narrow was
            higher before they blurred it, and their noise makes some.
        deviation: times the difference between a value and the mean of what the photos read there.
    """

    scatter: float
    contrast: float
    blur: float
    deviation: float


OF_POINT = Shares(0.7, 0.65, 0.0, 0.0)
"""Of what the photos' cameras see at a single point, so that there is no deviation."""

OF_MARK = Shares(0.9, 0.4, 4.0, 1.2)
"""Of the mean of a mark, which is over detail that is not resolved."""

READING, RENDERED = 0, 1
SHIFTS = slice(2, 6)
BLURRED = 6
CHANNELS = 7
"""What a photo shows of a place: what it reads, what the model shows from its camera, by how much
that changes ``SHIFT_PX`` to each of four sides, and by how much the camera's blur changes it; in
the unit of the values."""


class PhotoParts(NamedTuple):
    """The parts of P places, each half the width of an interval for 95 of 100 cases; NaN where no
    photo looked.

    Attributes:
        photos: from what the photos disagree by, and the rounding of their values, [P].
        model: from how much it changes nearby, and how far the value is from what the photos read,
            [P].
        detail: from how narrow a peak the place is, [P].
    """

    photos: Float[np.ndarray, " p"]
    model: Float[np.ndarray, " p"]
    detail: Float[np.ndarray, " p"]

    @property
    def total(self) -> Float[np.ndarray, " p"]:
        """All together, [P]."""
        return np.hypot(np.hypot(self.photos, self.model), self.detail)


class SightingSums:
    """What photos show of P places, gathered photo by photo.

    Args:
        places: P.
        rounding: half the width of the interval that the rounding of the photos' values leaves, in
            their unit; 0 if they are not rounded.
    """

    def __init__(self, places: int, rounding: float = 0.0) -> None:
        self._rounding = rounding
        self.photos = np.zeros(places, np.float32)
        self._readings, self._squares, self._contrast, self._blur = (
            np.zeros(places, np.float32) for _ in range(4)
        )

    def add(self, rows: Int64[np.ndarray, " m"], values: Float32[np.ndarray, "m c"]) -> None:
        """Add a photo.

        Args:
            rows: the places that it shows, each once.
            values: its channels there; places where one is NaN do not count.
        """
        known = np.isfinite(values).all(axis=1)
        rows, values = rows[known], values[known]
        self.photos[rows] += 1
        step = values[:, READING] - self._readings[rows]
        self._readings[rows] += step / self.photos[rows]
        self._squares[rows] += step * (values[:, READING] - self._readings[rows])
        self._contrast[rows] += np.square(values[:, SHIFTS]).mean(axis=1)
        self._blur[rows] += values[:, BLURRED]

    def parts(self, shares: Shares, values: Float[np.ndarray, " p"] | None = None) -> PhotoParts:
        """The parts of the uncertainty.

        Args:
            shares: how much of each counts.
            values: of the places, [P]; only needed where their deviation counts.
        """
        count = np.where(self.photos > 0, self.photos, np.float32(np.nan))
        scatter = np.sqrt(np.maximum(self._squares, 0) / count)
        contrast = np.sqrt(self._contrast / count)
        readings = np.where(self.photos > 0, self._readings, np.float32(np.nan))
        away = 0.0 if values is None else values - readings
        return PhotoParts(
            np.hypot(shares.scatter * scatter, self._rounding),
            np.hypot(shares.contrast * contrast, shares.deviation * away),
            shares.blur * np.abs(self._blur / count),
        )
