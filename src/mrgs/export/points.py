"""``points.ply`` and ``points.las``: the splats on surfaces as points with temperatures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from mrgs.data.ply import write_ply
from mrgs.export.job import ExportJob, comment_lines, described
from mrgs.export.surface_points import COLORS, SurfacePoints
from mrgs.maps.crs import CoordinateSystem, coordinate_system
from mrgs.scene import Scene
from mrgs.system.atomic import replacing
from mrgs.system.lazy import optional_package


def export(job: ExportJob) -> list[Path]:
    """Write ``points.ply`` and its sidecar."""
    path, facts = job.folder / "points.ply", job.surface_facts
    return described(write_points_ply(path, job.points, comment_lines(facts)), facts)


def write_points_ply(path: Path, points: SurfacePoints, comments: Sequence[str] = ()) -> Path:
    """Write x, y, z, red, green, blue, the temperature, other modalities and the opacity; returns
    the path. RunError if the file cannot be written."""
    columns: dict[str, np.ndarray] = {axis: points.positions[:, i] for i, axis in enumerate("xyz")}
    columns |= {**points.columns, "opacity": points.opacities}
    return write_ply(path, {"vertex": columns}, comments)


POINT_FORMAT, WITH_COLORS = 6, 7
"""Formats of LAS 1.4 without and with RGB."""

UNITS = {
    "temperature_c": "degrees Celsius",
    "uncertainty_c": "degrees, half of a 95 % interval",
    "opacity": "0 to 1",
}
"""Descriptions of the dimensions that have one."""

require_laspy = partial(optional_package, "laspy", "LAS files", "export")

FINEST_STEP = 1e-6
"""Coordinates are integers times a power of ten: this, or a larger one for widely spread points."""


def export_las(job: ExportJob) -> list[Path]:
    """Write ``points.las`` and its sidecar."""
    system = coordinate_system(job.scene, job.maps.crs) if job.scene.world.metric else None
    facts = job.surface_facts
    if system is not None:
        facts |= {"coordinates": "in the CRS"}
    return described(write_las(job.folder / "points.las", job.points, system), facts)


def require_las(scene: Scene, crs: str | None = None) -> None:
    """Check that LAS files can be written, in a CRS if the scene has a place on Earth. ConfigError
    if laspy is not installed, or the CRS cannot be used, see ``coordinate_system``."""
    require_laspy()
    if scene.world.is_georeferenced:
        coordinate_system(scene, crs)


def write_las(path: Path, points: SurfacePoints, system: CoordinateSystem | None = None) -> Path:
    """Write coordinates, 16-bit RGB if there is any, and as float32 the dimensions
    ``temperature_c`` (or _normalised), other modalities by name, and ``opacity``; in a coordinate
    system, or as they are without naming one. ConfigError if laspy is not installed, RunError if
    the file cannot be written."""
    laspy = require_laspy()
    columns = {**points.columns, "opacity": points.opacities}
    colors = {name: columns.pop(name) for name in COLORS if name in columns}
    header = laspy.LasHeader(point_format=WITH_COLORS if colors else POINT_FORMAT, version="1.4")
    header.generating_software = "mrgs"
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, np.float32, UNITS.get(name, "no unit")) for name in columns]
    )
    positions = points.positions.astype(np.float64)
    if system is not None:
        positions = system.apply(positions)
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(system.wkt))
        header.global_encoding.wkt = True
    low, high = positions.min(axis=0), positions.max(axis=0)
    header.offsets = low
    header.scales = np.full(
        3, max(FINEST_STEP, 10.0 ** math.ceil(math.log10(max((high - low).max(), 1e-300) / 2e9)))
    )
    las = laspy.LasData(header)
    las.x, las.y, las.z = positions.T
    for name, values in colors.items():
        las[name] = values.astype(np.uint16) * 257
    for name, values in columns.items():
        las[name] = values
    with replacing(path) as temporary:
        las.write(temporary)
    return path
