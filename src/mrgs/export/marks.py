"""``marks``: the marks of a run with their readings for GIS and CAD; and writers for maps there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from mrgs.errors import ConfigError
from mrgs.export.job import ExportJob
from mrgs.maps.crs import CoordinateSystem, coordinate_system, require_pyproj
from mrgs.maps.surfaces import MapGrid
from mrgs.marks.mark import Mark
from mrgs.marks.tables import facts_of_reading, value_text, write_features
from mrgs.scene import Scene
from mrgs.system.atomic import replacing
from mrgs.system.lazy import optional_package

Feature: TypeAlias = tuple[Mapping[str, Any], str, Mark]
"""A mark's reading under the names of the CSV file's columns, its label on a drawing, the mark."""

Placing: TypeAlias = Callable[[Float64[np.ndarray, "n 3"]], Float64[np.ndarray, "n 3"]]
"""Coordinates in a file of points of the scene."""

LAYERS = {"spots": ("spot",), "lines": ("line",), "areas": ("box", "polygon")}
"""Layers of a file, and the kinds of marks in them."""

LABEL_SHARE = 0.015
"""Height of a drawing's letters as a share of its longer side."""

require_pyogrio = partial(optional_package, "pyogrio", "GIS files", "export")
require_shapely = partial(optional_package, "shapely", "GIS files", "export")
require_ezdxf = partial(optional_package, "ezdxf", "CAD files", "export")


def require_marks(scene: Scene, crs: str | None = None) -> None:
    """Check that marks can be written in a CRS. ConfigError if pyogrio, shapely, ezdxf or pyproj is
    not installed; for others see ``coordinate_system``."""
    for require in (require_pyogrio, require_shapely, require_ezdxf, require_pyproj):
        require()
    coordinate_system(scene, crs)


def export(job: ExportJob) -> list[Path]:
    """Write ``marks.geojson``, ``marks.gpkg`` and ``marks.dxf``, and ``marks.kml`` of a scene with
    a place on Earth. ConfigError without marks."""
    found = features_of(job)
    if not found:
        raise ConfigError("the run has no marks to export: add some in the viewer or by a command")
    system, folder = coordinate_system(job.scene, job.maps.crs), job.folder
    plain = ((facts, mark) for facts, _, mark in found)
    paths = [
        write_features(folder / "marks.geojson", plain, job.scene.world),
        write_geopackage(folder / "marks.gpkg", found, system),
        write_dxf(folder / "marks.dxf", found, system.apply),
    ]
    if system.on_earth:
        paths.append(write_kml(folder / "marks.kml", found, system))
    return paths


def features_of(job: ExportJob) -> list[Feature]:
    """The marks of a run with their readings; none without a run."""
    marks = job.marks
    if marks is None:
        return []
    known, found = marks.run.temperature, list[Feature]()
    for reading in job.readings:
        facts = facts_of_reading(reading, known, marks.world, marks.assumptions_of(reading))
        label = f"{reading.mark.name} {value_text(reading.mean, known, unit=True)}"
        found.append((facts, label, reading.mark))
    return found


def write_geopackage(path: Path, found: Sequence[Feature], system: CoordinateSystem) -> Path:
    """Write ``LAYERS`` of marks with their readings, in a coordinate system; returns the path.
    RunError if the file cannot be written."""
    with replacing(path) as temporary:
        for layer, kinds in LAYERS.items():
            if chosen := [each for each in found if each[2].kind in kinds]:
                _write_layer(temporary, chosen, system, driver="GPKG", layer=layer)
    return path


def write_kml(path: Path, found: Sequence[Feature], system: CoordinateSystem) -> Path:
    """Write marks with their readings for Google Earth and others, from a coordinate system on
    Earth; returns the path. RunError if the file cannot be written."""
    with replacing(path) as temporary:
        # LIBKML refuses polygons that are a line in plan, as those on a wall are.
        _write_layer(temporary, found, system, driver="KML", layer="marks")
    return path


def _write_layer(
    path: Path, found: Sequence[Feature], system: CoordinateSystem, **options: str
) -> None:
    """Add marks to a file by GDAL. OSError if it cannot be written."""
    pyogrio, shapely = require_pyogrio(), require_shapely()
    geometries = [_geometry(shapely, mark, system.apply) for *_, mark in found]
    names, kinds = list(found[0][0]), {each.geom_type for each in geometries}
    columns = [_column([facts[name] for facts, *_ in found]) for name in names]
    try:
        pyogrio.raw.write(
            str(path), shapely.to_wkb(geometries), columns, names, crs=system.wkt,
            geometry_type=f"{kinds.pop()} Z" if len(kinds) == 1 else "Unknown",
            append=path.exists(), **options,
        )  # fmt: skip
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise OSError(0, f"GDAL: {error}") from error


def _geometry(shapely: Any, mark: Mark, place: Placing) -> Any:
    places = place(np.array(mark.points, dtype=np.float64))
    if mark.kind == "spot":
        return shapely.Point(places[0])
    return (shapely.LineString if mark.kind == "line" else shapely.Polygon)(places)


def _column(values: Sequence[Any]) -> np.ndarray:
    """Texts, or numbers with NaN for what is not known."""
    if any(isinstance(value, str) for value in values):
        return np.array(values, dtype=object)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def write_dxf(
    path: Path,
    found: Sequence[Feature],
    place: Placing,
    map_picture: tuple[str, MapGrid] | None = None,
) -> Path:
    """Write marks with names and temperatures as a drawing in metres; returns the path. A map's
    picture in the same folder, given by its file name and its grid, lies true to scale below them.
    RunError if the file cannot be written."""
    ezdxf = require_ezdxf()
    document = ezdxf.new("R2010", units=ezdxf.units.M)
    space, sizes = document.modelspace(), [np.zeros(2)]
    if map_picture is not None:
        name, grid = map_picture
        size = np.array([grid.width, grid.height]) * grid.pixel_m
        picture = document.add_image_def(name, (grid.width, grid.height))
        document.layers.add("map")
        lower_left = (grid.left, grid.top - size[1], 0.0)
        space.add_image(picture, lower_left, tuple(size), dxfattribs={"layer": "map"})
        sizes.append(size)
    placed = [place(np.array(mark.points, dtype=np.float64)) for *_, mark in found]
    if placed:
        sizes.append(np.ptp(np.concatenate(placed)[:, :2], axis=0))
    height = LABEL_SHARE * float(np.max(sizes)) or LABEL_SHARE
    for layer, color in zip(LAYERS, (1, 4, 3), strict=True):  # red, cyan, green
        document.layers.add(layer, color=color)
    for (_, label, mark), places in zip(found, placed, strict=True):
        layer = next(each for each, kinds in LAYERS.items() if mark.kind in kinds)
        own = {"layer": layer}
        if mark.kind == "spot":
            space.add_circle(places[0], mark.radius, dxfattribs=own)
            space.add_point(places[0], dxfattribs=own)
        else:
            space.add_polyline3d(places, close=mark.is_area, dxfattribs=own)
        text = space.add_text(label, height=height, dxfattribs=own)
        beside = mark.radius + height / 2
        text.set_placement(places.mean(axis=0) + np.array([beside, 0, 0]))
    with replacing(path) as temporary:
        document.saveas(temporary)
    return path
