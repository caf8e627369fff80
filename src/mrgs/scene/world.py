"""What is known of a scene's world frame: whether its unit is the metre, and where on Earth it
lies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class EarthPosition(NamedTuple):
    """A place on Earth, WGS 84: degrees north and east, metres above sea level or None."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None


@dataclass(frozen=True)
class WorldFrame:
    """The frame of a scene's coordinates.

    Attributes:
        metric: whether its unit is the metre.
        north: whether its axes point east, north and up.
        origin: of its coordinates on Earth; None if not known.
        residual_m: median distance of the cameras from their GPS positions, m; None without GPS.
        scale_error: standard uncertainty of its unit, as a share; None where that is not known.
    """

    metric: bool = False
    north: bool = False
    origin: EarthPosition | None = None
    residual_m: float | None = None
    scale_error: float | None = None

    @property
    def is_georeferenced(self) -> bool:
        """Whether every point of the scene has a known place on Earth."""
        return self.metric and self.north and self.origin is not None

    @property
    def length_unit(self) -> str:
        """``m``, or ``scene units``."""
        return "m" if self.metric else "scene units"
