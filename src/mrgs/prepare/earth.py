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

SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1 / 298.257223563


def ecef(position: GpsPosition) -> Float64[np.ndarray, "3"]:
    """Earth-centred coordinates (ECEF) [3], metres; an unknown height counts as 0."""
    latitude, longitude = np.radians([position.latitude_deg, position.longitude_deg])
    height_m = position.altitude_m or 0.0
    squared_eccentricity = FLATTENING * (2 - FLATTENING)
    curvature_m = SEMI_MAJOR_AXIS_M / np.sqrt(1 - squared_eccentricity * np.sin(latitude) ** 2)
    across = (curvature_m + height_m) * np.cos(latitude)
    along_axis = (curvature_m * (1 - squared_eccentricity) + height_m) * np.sin(latitude)
    return np.array([across * np.cos(longitude), across * np.sin(longitude), along_axis])


def enu(positions: Sequence[GpsPosition], origin: GpsPosition) -> Float64[np.ndarray, "n 3"]:
    """Positions in metres east, north and up of ``origin`` [N, 3]."""
    latitude, longitude = np.radians([origin.latitude_deg, origin.longitude_deg])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ]
    )
    axes = np.stack([east, np.cross(up, east), up])
    offsets = np.array([ecef(position) for position in positions]) - ecef(origin)
    return np.einsum("ij,nj->ni", axes, offsets)
