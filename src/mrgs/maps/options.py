"""What a user may choose of a map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from mrgs.errors import ConfigError

ThreePoints = tuple[
    tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
]

MIN_SINE = 0.02
"""Sine of the angle at the first of three points below which they lie on a line."""


@dataclass(frozen=True)
class MapOptions:
    """Choices for the maps of an export. ConfigError for a pixel size that is not above 0, or three
    points that span no plane.

    Attributes:
        plane: three points of a façade in the scene's coordinates: lower left, lower right, and one
            above them; None to find the façade.
        pixel_size_m: side of a pixel; None takes that of the photos.
        crs: a projected coordinate reference system, such as ``EPSG:25832``; None takes the UTM
            zone.
    """

    plane: ThreePoints | None = None
    pixel_size_m: float | None = None
    crs: str | None = None

    def __post_init__(self) -> None:
        size = self.pixel_size_m
        if size is not None and not (math.isfinite(size) and size > 0):
            raise ConfigError(
                f"a pixel of {size:g} m is not possible; give a size above 0",
                options=("pixel_size_m",),
            )
        if self.plane is not None:
            across, aside = np.diff(self.points, axis=0)[0], self.points[2] - self.points[0]
            area = np.linalg.norm(np.cross(across, aside))
            if not area > MIN_SINE * np.linalg.norm(across) * np.linalg.norm(aside):
                raise ConfigError(
                    "the three points of the plane lie on a line; give lower left, lower right, "
                    "and one above them",
                    options=("plane",),
                )

    @property
    def points(self) -> Float64[np.ndarray, "3 3"]:
        """The points of ``plane``, one a row."""
        return np.array(self.plane, dtype=np.float64)


def parse_plane(first: str, second: str, third: str) -> ThreePoints:
    """Three points ``X,Y,Z``. ConfigError if they are not."""
    return _point(first), _point(second), _point(third)


def _point(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise ConfigError(
            f"{text!r} is not a point; write X,Y,Z, such as 1.5,0,2", options=("plane",)
        )
    return x, y, z
