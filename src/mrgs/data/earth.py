"""Positions on Earth in metres: WGS 84, Earth-centred coordinates (ECEF), and east, north, up at a
place (ENU).

National Imagery and Mapping Agency, TR8350.2, "World Geodetic System 1984". EXIF gives heights
above sea level; they are used as heights above the ellipsoid: the difference, at most 100 m, moves
the origin up and changes lengths by 2e-5.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from mrgs.data.radiometric import GpsPosition
from mrgs.errors import ConfigError
from mrgs.scene import EarthPosition
from mrgs.system.lazy import optional_package

require_pyproj = partial(optional_package, "pyproj", "map coordinates", "export")

BEYOND_AREA_DEG = 3.0
"""Surveys use a CRS this far outside of the area that it is made for."""

SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1 / 298.257223563
_SQUARED_ECCENTRICITY = FLATTENING * (2 - FLATTENING)

_ITERATIONS = 6
"""Each gains two digits or more; below 1 nm on the ground."""


Position: TypeAlias = GpsPosition | EarthPosition


def ecef(position: Position) -> Float64[np.ndarray, "3"]:
    """Earth-centred coordinates (ECEF) [3], metres; an unknown height counts as 0."""
    latitude, longitude = np.radians([position.latitude_deg, position.longitude_deg])
    height_m = position.altitude_m or 0.0
    curvature_m = SEMI_MAJOR_AXIS_M / np.sqrt(1 - _SQUARED_ECCENTRICITY * np.sin(latitude) ** 2)
    across = (curvature_m + height_m) * np.cos(latitude)
    along_axis = (curvature_m * (1 - _SQUARED_ECCENTRICITY) + height_m) * np.sin(latitude)
    return np.array([across * np.cos(longitude), across * np.sin(longitude), along_axis])


def enu(positions: Sequence[Position], origin: Position) -> Float64[np.ndarray, "n 3"]:
    """Positions in metres east, north and up of ``origin`` [N, 3]."""
    offsets = np.array([ecef(position) for position in positions]) - ecef(origin)
    return np.einsum("ij,nj->ni", _axes(origin), offsets)


def geodetic(offset_m: Float64[np.ndarray, "3"], origin: Position) -> EarthPosition:
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


def _axes(origin: Position) -> Float64[np.ndarray, "3 3"]:
    """Unit vectors to the east, to the north and up at a position, in ECEF; rows."""
    latitude, longitude = np.radians([origin.latitude_deg, origin.longitude_deg])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    across = np.cos(latitude)
    up = np.array([across * np.cos(longitude), across * np.sin(longitude), np.sin(latitude)])
    return np.stack([east, np.cross(up, east), up])


def projected_crs(name: str) -> Any:
    """A coordinate reference system in metres, by a code such as ``EPSG:25832``. ConfigError if
    there is none of this name, it is not projected, or pyproj is not installed."""
    pyproj = require_pyproj()
    try:
        crs = pyproj.CRS.from_user_input(name)
    except pyproj.exceptions.CRSError:
        raise ConfigError(
            f"unknown CRS {name!r}; give a code such as EPSG:25832", options=("crs",)
        ) from None
    if not crs.is_projected or {axis.unit_name for axis in crs.axis_info[:2]} != {"metre"}:
        raise ConfigError(
            f"{name} ({crs.name}) is not a projected CRS in metres; give one such as EPSG:25832",
            options=("crs",),
        )
    return crs


def on_earth(places: Float64[np.ndarray, "n 3"], crs: str) -> list[GpsPosition]:
    """Positions of easting, northing and height [N, 3] in a CRS. ConfigError as for
    ``projected_crs``, and if a place is far from where the CRS is for."""
    system = projected_crs(crs)
    to_degrees = require_pyproj().Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    found = np.column_stack(to_degrees.transform(places[:, 0], places[:, 1]))
    area = system.area_of_use
    low, high = np.reshape(area.bounds if area else (-180, -90, 180, 90), (2, 2))
    if not (np.maximum(low - found, found - high) <= BEYOND_AREA_DEG).all():
        raise ConfigError(
            f"the coordinates are not where {system.name} is for; name their CRS, and swap east "
            f"and north if these are swapped"
        )
    return [GpsPosition(y, x, z) for (x, y), z in zip(found.tolist(), places[:, 2], strict=True)]
