"""Positions on Earth in metres: WGS 84, Earth-centred coordinates (ECEF), and east, north, up at a
place (ENU).

National Imagery and Mapping Agency, TR8350.2, "World Geodetic System 1984". EXIF gives heights
above sea level; they are used as heights above the ellipsoid: the difference, at most 100 m, moves
the origin up and changes lengths by 2e-5.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from mrgs.data.radiometric import GpsPosition
from mrgs.scene import EarthPosition

SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1 / 298.257223563
_SQUARED_ECCENTRICITY = FLATTENING * (2 - FLATTENING)

_ITERATIONS = 6
"""Each gains two digits or more; below 1 nm on the ground."""


def ecef(position: GpsPosition | EarthPosition) -> Float64[np.ndarray, "3"]:
    """Earth-centred coordinates (ECEF) [3], metres; an unknown height counts as 0."""
    latitude, longitude = np.radians([position.latitude_deg, position.longitude_deg])
    height_m = position.altitude_m or 0.0
    curvature_m = SEMI_MAJOR_AXIS_M / np.sqrt(1 - _SQUARED_ECCENTRICITY * np.sin(latitude) ** 2)
    across = (curvature_m + height_m) * np.cos(latitude)
    along_axis = (curvature_m * (1 - _SQUARED_ECCENTRICITY) + height_m) * np.sin(latitude)
    return np.array([across * np.cos(longitude), across * np.sin(longitude), along_axis])


def enu(positions: Sequence[GpsPosition], origin: GpsPosition) -> Float64[np.ndarray, "n 3"]:
    """Positions in metres east, north and up of ``origin`` [N, 3]."""
    offsets = np.array([ecef(position) for position in positions]) - ecef(origin)
    return np.einsum("ij,nj->ni", _axes(origin), offsets)


def geodetic(
    offset_m: Float64[np.ndarray, "3"], origin: GpsPosition | EarthPosition
) -> EarthPosition:
    """The position at an offset of metres east, north and up from another; undoes ``enu``."""
    x, y, z = ecef(origin) + _axes(origin).T @ offset_m
    across, height_m = np.hypot(x, y), 0.0
    latitude = np.arctan2(z, across * (1 - _SQUARED_ECCENTRICITY))
    for _ in range(_ITERATIONS):
        curvature_m = SEMI_MAJOR_AXIS_M / np.sqrt(1 - _SQUARED_ECCENTRICITY * np.sin(latitude) ** 2)
        height_m = across / np.cos(latitude) - curvature_m
        flattened = 1 - _SQUARED_ECCENTRICITY * curvature_m / (curvature_m + height_m)
        latitude = np.arctan2(z, across * flattened)
    longitude = np.arctan2(y, x)
    return EarthPosition(float(np.degrees(latitude)), float(np.degrees(longitude)), float(height_m))


def _axes(origin: GpsPosition | EarthPosition) -> Float64[np.ndarray, "3 3"]:
    """Unit vectors to the east, to the north and up at a position, in ECEF; rows."""
    latitude, longitude = np.radians([origin.latitude_deg, origin.longitude_deg])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    across = np.cos(latitude)
    up = np.array([across * np.cos(longitude), across * np.sin(longitude), np.sin(latitude)])
    return np.stack([east, np.cross(up, east), up])
