"""``ortho`` and ``elevation``: maps as GeoTIFFs with sidecars and QGIS styles, as pictures,
as drawings for CAD, and on Earth as overlays for globes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from PIL import Image

from mrgs.errors import ConfigError
from mrgs.export.job import ExportJob, comment_lines, described
from mrgs.export.marks import features_of, require_ezdxf, write_dxf
from mrgs.maps.crs import (
    LOCAL,
    CoordinateSystem,
    coordinate_system,
    local_wkt,
    require_metres,
    require_pyproj,
)
from mrgs.maps.draw import (
    BANDS,
    Caption,
    OrthographicMap,
    draw_map,
    map_picture,
    map_scale,
    require_rasterio,
    write_geotiff,
    write_kmz,
    write_style,
)
from mrgs.maps.facade import facade_grid
from mrgs.maps.surfaces import grid_from_above, seen_surfaces
from mrgs.pictures.files import write_png
from mrgs.scene import THERMAL, Scene
from mrgs.system.wording import number_text

UNSEEN = "white: no surface, or too few photos look there"
COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


def require_elevation(scene: Scene, crs: str | None = None) -> None:
    """Check that the map of a façade can be written, which is in no CRS. ConfigError if rasterio,
    pyproj or ezdxf is not installed, the scene has no °C, or is not known to be in metres."""
    for require in (require_rasterio, require_pyproj, require_ezdxf):
        require()
    if scene.temperature is None or THERMAL not in scene.modalities:
        raise ConfigError(
            f"{scene.name} has no temperatures in °C, which a map shows: give it a "
            f"temperature_bounds.json, or thermal photos in °C"
        )
    require_metres(scene)


def require_ortho(scene: Scene, crs: str | None = None) -> None:
    """Check that the map from above can be written in a CRS. Errors as for ``require_elevation``
    and ``coordinate_system``."""
    require_elevation(scene)
    coordinate_system(scene, crs)


def export_ortho(job: ExportJob) -> list[Path]:
    """Write ``ortho.tif`` with its sidecar and its style for QGIS, ``ortho.png``, ``ortho.dxf``
    with the picture in it, and of a scene with a place on Earth ``ortho.kmz``."""
    system = coordinate_system(job.scene, job.maps.crs)
    maps = seen_surfaces(job.baked, job.scene)
    grid, coverage = grid_from_above(job.scene, maps, system, job.maps)
    drawn = draw_map(job.baked, job.scene, maps, grid, job.appraised, coverage)
    return _write_map(job, "ortho", drawn, system, *ortho_texts(job.scene.name, drawn, system))


def ortho_texts(
    name: str, drawn: OrthographicMap, system: CoordinateSystem
) -> tuple[Caption, dict[str, Any]]:
    """The texts of the picture of a map from above, and the facts of its sidecar."""
    north = " · north is up" if system.north else ""
    caption = Caption(
        f"{name}: temperatures from above",
        f"{system.name}{north} · {drawn.grid.pixel_m * 100:g} cm per pixel",
        _summary(drawn),
        system.north_deg,
    )
    facts: dict[str, Any] = {
        "map": "orthographic, from above",
        "map_crs": system.name,
        "map_crs_residual_m": round(system.residual_m, 6),
    }
    if system.north_deg is not None:
        facts["map_north_clockwise_from_up_deg"] = round(system.north_deg, 3)
    return caption, facts


def export_elevation(job: ExportJob) -> list[Path]:
    """Write ``elevation.tif`` with its sidecar and its style for QGIS, ``elevation.png``, and
    ``elevation.dxf`` with the picture in it.

    Its coordinates are metres to the right and upwards from the lower left corner of the map, whose
    place in the scene is in the sidecar.
    """
    maps = seen_surfaces(job.baked, job.scene)
    grid = facade_grid(job.scene, maps, job.maps)
    drawn = draw_map(job.baked, job.scene, maps, grid, job.appraised)
    system = replace(LOCAL, wkt=local_wkt(f"{job.scene.name} façade"))
    return _write_map(job, "elevation", drawn, system, *elevation_texts(job.scene, drawn))


def elevation_texts(scene: Scene, drawn: OrthographicMap) -> tuple[Caption, dict[str, Any]]:
    """The texts of a façade's picture, and the facts of its sidecar."""
    grid = drawn.grid
    facts = {
        "map": "orthographic, of a façade",
        "map_crs": "metres to the right and upwards from the map's lower left corner",
    }
    facing = ""
    if scene.world.north:
        azimuth = float(np.degrees(np.arctan2(grid.axes[2, 0], grid.axes[2, 1])) % 360)
        facts |= {"faces_azimuth_deg": f"{azimuth:.1f}"}
        facing = f" · faces {COMPASS[round(azimuth / 45) % 8]} ({azimuth:.0f}°)"
    size = f"{grid.width * grid.pixel_m:.4g} × {grid.height * grid.pixel_m:.4g} m"
    subtitle = f"{size}{facing} · {grid.pixel_m * 100:g} cm per pixel"
    return Caption(f"{scene.name}: facade temperatures", subtitle, _summary(drawn), None), facts


def _write_map(
    job: ExportJob,
    name: str,
    drawn: OrthographicMap,
    system: CoordinateSystem,
    caption: Caption,
    facts: dict[str, Any],
) -> list[Path]:
    """Write ``NAME.tif``, ``NAME.qml`` and ``NAME.png``, ``NAME.dxf`` with ``NAME_map.png``, on
    Earth ``NAME.kmz``; returns the paths."""
    grid = drawn.grid
    shown = [each for each in features_of(job) if grid.shows(np.array(each[2].points))]

    def flat(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        return np.column_stack([grid.to_map(points), np.zeros(len(points))])

    facts = job.surface_facts | {
        **facts,
        "bands": BANDS,
        "pixel_m": grid.pixel_m,
        "map_corner_in_scene": [round(float(x), 6) for x in grid.lower_left],
        "map_right_in_scene": [round(float(x), 9) for x in grid.axes[0]],
        "map_up_in_scene": [round(float(x), 9) for x in grid.axes[1]],
    }
    tags = dict(line.split(": ", 1) for line in comment_lines(facts))
    paths = described(
        write_geotiff(job.folder / f"{name}.tif", grid, drawn.bands, BANDS, system.wkt, tags), facts
    )
    scale = map_scale(drawn, job.palette, job.range_c)
    paths.append(write_style(job.folder / f"{name}.qml", scale))
    paths.append(write_png(job.folder / f"{name}.png", map_picture(drawn, caption, scale)))
    known = np.isfinite(drawn.celsius)
    pixels = np.dstack([scale.colorize(drawn.celsius), 255 * known.astype(np.uint8)])
    bare = write_png(job.folder / f"{name}_map.png", Image.fromarray(pixels))
    paths += [bare, write_dxf(job.folder / f"{name}.dxf", shown, flat, (bare.name, grid))]
    if system.on_earth:
        paths.append(write_kmz(job.folder / f"{name}.kmz", pixels, grid, system.wkt))
    return paths


def _summary(drawn: OrthographicMap) -> str:
    """Temperatures and photos of a map, in one line."""
    known = np.isfinite(drawn.celsius)
    celsius, photos = drawn.celsius[known], np.median(drawn.bands[4][known])
    low, high = (number_text(float(each), 1) for each in (celsius.min(), celsius.max()))
    return f"{low} to {high} °C · {photos:.0f} photos per place (median) · {UNSEEN}"
