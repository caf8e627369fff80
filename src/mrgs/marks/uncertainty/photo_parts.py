"""The parts of a temperature's uncertainty that photos and model tell by themselves.

The constants were set on generated scenes with exact temperatures, and checked on others: see
``docs/decisions/036-uncertainty.md``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

SCATTER = 0.7
"""Times the standard deviation of the photos' readings. It is not divided by the root of their
number: what they disagree by at one place, a reflection or a wrong depth, their mean keeps."""

CONTRAST = 4.5
"""Times the change of the model within a pixel, over the root of the number of photos: places and
poses are known to a few pixels, and a camera's blur is undone to a few."""

DEVIATION = 2.0
"""Times the difference between a value and the mean of what the photos' cameras see there."""

READING, RENDERED, CONTRAST_SQUARED = 0, 1, 2
"""What a photo shows of a place: what it reads, what the model shows from its camera, and the
square of how much that changes within a pixel; in the unit of the values."""

CHANNELS = 3


class PhotoParts(NamedTuple):
    """The parts of P places, each half the width of an interval for 95 of 100 cases; NaN where no
    photo looked.

    Attributes:
        photos: from what the photos disagree by, [P].
        model: from how sharp the place is, and how far the value is from what the photos' cameras
            see in the model, [P].
    """

    photos: Float[np.ndarray, " p"]
    model: Float[np.ndarray, " p"]

    @property
    def total(self) -> Float[np.ndarray, " p"]:
        """Both together, [P]."""
        return np.hypot(self.photos, self.model)


class SightingSums:
    """What photos show of P places, gathered photo by photo.

    Args:
        places: P.
    """

    def __init__(self, places: int) -> None:
        self.photos = np.zeros(places, np.float32)
        self._readings, self._squares, self._rendered, self._contrast = (
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
        self._rendered[rows] += values[:, RENDERED]
        self._contrast[rows] += values[:, CONTRAST_SQUARED]

    def parts(self, values: Float[np.ndarray, " p"] | None = None) -> PhotoParts:
        """The parts of the uncertainty of values, [P]; of what the photos' cameras see in the model
        if None."""
        count = np.where(self.photos > 0, self.photos, np.float32(np.nan))
        scatter = np.sqrt(np.maximum(self._squares, 0) / count)
        contrast = np.sqrt(self._contrast) / count
        away = 0.0 if values is None else values - self._rendered / count
        return PhotoParts(SCATTER * scatter, np.hypot(CONTRAST * contrast, DEVIATION * away))
