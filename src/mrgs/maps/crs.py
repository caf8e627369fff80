"""The coordinate reference system (CRS) of exported coordinates.

Where GPS placed the scene, coordinates become those of a projected CRS: UTM on WGS 84, or any other
in metres. East, north, up at the scene's origin (ENU) and map coordinates differ by more than a
similarity, but over a scene by millimetres; the residual is reported.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any
from unicodedata import normalize

import numpy as np
from jaxtyping import Float64

from mrgs.data.earth import projected_crs, require_pyproj
from mrgs.errors import ConfigError
from mrgs.scene import EarthPosition, Scene

UTM_LATITUDES_DEG = (-80.0, 84.0)
"""UTM is defined between these."""

UTM_NORTH, UTM_SOUTH = 32600, 32700
"""EPSG codes of UTM on WGS 84, to which the number of the zone is added."""

LOCAL_NAME = "the scene's own frame, metres"

NORTH_IS_UP_DEG = 5.0
"""North may be turned this far from up on a map that has it up: UTM's is, by up to 3°."""

MAX_STRETCH = 0.1
"""Metres of a CRS may be longer or shorter than those on the ground by this share."""

MAX_DISTORTION = 0.05
"""Largest distance between similarity and exact projection, as a share of the scene's radius."""


@dataclass(frozen=True, eq=False)
class CoordinateSystem:
    """Where exported coordinates lie.

    Attributes:
        name: for people, such as ``EPSG:32632, WGS 84 / UTM zone 32N``.
        wkt: as well-known text of 2001 (WKT 1), which GIS and LAS readers know best.
        matrix: from the scene's coordinates (x, y, z, 1) to easting, northing and height above sea
            level in metres, [4, 4]; or to those of a local frame.
        on_earth: whether it is a CRS on Earth; else the scene's own frame.
        residual_m: largest distance, over the scene, between ``matrix`` and the exact projection.
    """

    name: str
    wkt: str
    matrix: Float64[np.ndarray, "4 4"]
    on_earth: bool
    residual_m: float

    @property
    def north_deg(self) -> float | None:
        """Direction of north at the scene's origin, clockwise from the second axis, in degrees;
        None in a scene without a place on Earth."""
        if not self.on_earth:
            return None
        return float(np.degrees(np.arctan2(self.matrix[0, 1], self.matrix[1, 1])))

    @property
    def north(self) -> bool:
        """Whether the second axis points north, within ``NORTH_IS_UP_DEG``."""
        return self.north_deg is not None and abs(self.north_deg) < NORTH_IS_UP_DEG

    @property
    def scale(self) -> float:
        """Map metres per metre on the ground: 0.9996 in the middle of a UTM zone."""
        return float(np.hypot(self.matrix[0, 0], self.matrix[1, 0]))

    def apply(self, positions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Coordinates of points of the scene, [N, 3]."""
        return np.einsum("ij,nj->ni", self.matrix[:3, :3], positions) + self.matrix[:3, 3]


LOCAL = CoordinateSystem(LOCAL_NAME, "", np.eye(4), False, 0.0)
"""A scene's own frame."""


def coordinate_system(scene: Scene, wanted: str | None = None) -> CoordinateSystem:
    """The CRS of a scene in metres: where GPS placed the scene the wanted projected one, such as
    ``EPSG:25832``, or by default the UTM zone; else a local one. ConfigError if the scene is not
    known to be in metres; the wanted CRS does not exist, is not in metres, does not cover the
    scene, or is mirrored or not true to scale there; the scene is not georeferenced, or is beyond
    UTM; or pyproj is not installed."""
    require_metres(scene)
    world = scene.world
    if not world.is_georeferenced or world.origin is None:
        if wanted is not None:
            raise ConfigError(
                f"{scene.name} is not georeferenced, so {wanted} cannot be used: prepare it from "
                f"photos with GPS or control points that name their CRS, or leave the CRS out",
                options=("crs",),
            )
        matrix = np.eye(4)
        matrix[:3, 3] = world.offset or 0.0
        name = LOCAL_NAME if world.offset is None else "the local frame of the survey, metres"
        return replace(LOCAL, name=name, wkt=local_wkt(scene.name), matrix=matrix)
    pyproj = require_pyproj()
    crs = _utm(pyproj, world.origin) if wanted is None else _wanted(wanted, world.origin)
    code = crs.to_authority()
    name = crs.name if code is None else f"{':'.join(code)}, {crs.name}"
    matrix, residual_m = _from_scene(pyproj, crs, world.origin, scene.reach.radius)
    return CoordinateSystem(name, crs.to_wkt("WKT1_GDAL"), matrix, True, residual_m)


def require_metres(scene: Scene) -> None:
    """Check that a scene is in metres; ConfigError if that is not known."""
    if not scene.world.metric:
        raise ConfigError(
            f"{scene.name} has no scale, so it has no coordinates in metres: prepare it with GPS, "
            f"control points or a known distance; if its poses are in metres, add "
            f'"georeference": {{"units": "metres"}} to its transforms.json',
            options=("known_distance",),
        )


def place_facts(scene: Scene, wanted: str | None = None) -> Mapping[str, Any]:
    """What is known of the scene's place, for a sidecar and header comments; needs no package."""
    world = scene.world
    if not world.metric:
        return {}
    facts: dict[str, Any] = {"axes": "east, north, up" if world.north else "not known"}
    if world.origin is not None:
        facts["origin"] = world.origin._asdict()
    if world.offset is not None:
        facts["offset"] = world.offset
    if world.residual_m is not None:
        facts["gps_residual_m"] = round(world.residual_m, 3)
    with suppress(ConfigError):  # beyond UTM, or pyproj is not installed
        system = coordinate_system(scene, wanted)
        matrix = [[float(x) for x in row] for row in system.matrix]
        facts |= {"crs": system.name, "crs_from_scene": matrix}
    return facts


def local_wkt(name: str) -> str:
    """A local CRS in metres, as well-known text of 2001, whose names are ASCII in GeoTIFF: letters
    lose their accents, or are left out."""
    ascii_name = normalize("NFKD", name.replace("ß", "ss")).encode("ascii", "ignore").decode()
    quoted = "".join(char for char in ascii_name if char.isprintable() and char not in '"[]')
    return (
        f'LOCAL_CS["{quoted}",LOCAL_DATUM["origin of the scene",0],UNIT["metre",1],'
        f'AXIS["x",EAST],AXIS["y",NORTH]]'
    )


def _utm(pyproj: ModuleType, origin: EarthPosition) -> Any:
    low, high = UTM_LATITUDES_DEG
    if not low <= origin.latitude_deg <= high:
        raise ConfigError(
            f"UTM ends at {low:g}° and {high:g}° of latitude, and the scene lies at "
            f"{origin.latitude_deg:.4f}°: give a polar CRS, such as EPSG:3413 or EPSG:3031",
            options=("crs",),
        )
    zone = min(int((origin.longitude_deg + 180) // 6) + 1, 60)
    return pyproj.CRS.from_epsg((UTM_NORTH if origin.latitude_deg >= 0 else UTM_SOUTH) + zone)


def _wanted(wanted: str, origin: EarthPosition) -> Any:
    crs = projected_crs(wanted)
    area, longitude = crs.area_of_use, origin.longitude_deg
    if area is None:
        return crs
    beyond = longitude < area.west, longitude > area.east
    across = all(beyond) if area.west > area.east else any(beyond)
    if across or not area.south <= origin.latitude_deg <= area.north:
        raise ConfigError(
            f"{wanted} ({crs.name}) does not cover the scene at {origin.latitude_deg:.4f}°, "
            f"{longitude:.4f}°; choose one that does, or leave it out for UTM",
            options=("crs",),
        )
    return crs


def _from_scene(
    pyproj: ModuleType, crs: Any, origin: EarthPosition, radius: float
) -> tuple[Float64[np.ndarray, "4 4"], float]:
    """The similarity from ENU to a projected CRS that fits best in the plane within a radius (m),
    and its largest distance from the exact projection; heights stay. ConfigError if none fits."""
    height = origin.altitude_m or 0.0
    place = f"+lat_0={origin.latitude_deg!r} +lon_0={origin.longitude_deg!r} +h_0={height!r}"
    to_degrees = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 {place} "
        f"+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    to_map = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    steps = radius * np.linspace(-1, 1, 5)
    east, north = (axis.ravel() for axis in np.meshgrid(steps, steps))
    longitude, latitude, _ = to_degrees.transform(east, north, np.zeros_like(east))
    there = np.array(to_map.transform(longitude, latitude))
    here = np.stack([east, north])
    # An affine map of the plane is two complex factors: (E + iN) = factor · (east + i north)
    # + mirrored · (east − i north) + offset. A similarity has the first alone.
    scene, target = here[0] + 1j * here[1], there[0] + 1j * there[1]
    offset = target.mean()
    factor, mirrored = (
        np.vdot(basis, target - offset) / np.vdot(basis, basis) for basis in (scene, scene.conj())
    )
    residual = float(np.abs(factor * scene + offset - target).max())
    _require_similar(crs, abs(factor), abs(mirrored), residual / radius)
    matrix = np.eye(4)
    matrix[:2, :2] = [[factor.real, -factor.imag], [factor.imag, factor.real]]
    matrix[:3, 3] = offset.real, offset.imag, height
    return matrix, residual


def _require_similar(crs: Any, scale: float, mirrored: float, distortion: float) -> None:
    """Refuse a CRS that mirrors, stretches or distorts the scene's place. GIS (and PROJ) swap
    northing and easting, but not southings and westings, which turn or mirror the map."""
    if not np.isfinite(distortion):
        problem = "has no coordinates for the scene's place; choose another CRS"
    elif mirrored > scale:
        axes = " and ".join(axis.direction for axis in crs.axis_info[:2])
        problem = (
            f"counts towards {axes}, so maps in it would be mirror images; choose another CRS, "
            f"whose axes point east and north (EPSG:5514 in place of EPSG:5513)"
        )
    elif abs(scale - 1) > MAX_STRETCH:
        problem = (
            f"is not true to scale at the scene's place, where a metre on the ground is "
            f"{scale:.2f} m; choose another CRS"
        )
    elif distortion > MAX_DISTORTION:
        problem = f"distorts the scene's place by {distortion:.0%}; choose another CRS, such as UTM"
    else:
        return
    raise ConfigError(f"{crs.name} {problem}", options=("crs",))
