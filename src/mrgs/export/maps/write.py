"""A map's files: the GeoTIFF with its sidecar and its style, and the picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrgs.errors import ConfigError
from mrgs.export.crs import require_metres, require_pyproj
from mrgs.export.job import ExportJob, described
from mrgs.export.maps.draw import BANDS, OrthographicMap
from mrgs.export.maps.geotiff import require_rasterio, write_geotiff
from mrgs.export.maps.options import MapOptions
from mrgs.export.maps.photos import median_distance
from mrgs.export.maps.picture import Caption, map_picture, map_scale
from mrgs.export.maps.style import write_style
from mrgs.export.sidecar import UP_SNAP, comment_lines, up_direction
from mrgs.pictures.files import write_png
from mrgs.pictures.numbers import number_text
from mrgs.scene import THERMAL, Scene
from mrgs.scene.depth_map import DepthMap

UNSEEN = "white: no surface, or too few photos look there"


def require_map(scene: Scene) -> None:
    """Check that a map of a scene can be written.

    Raises:
        ConfigError: rasterio or pyproj is not installed, the scene has no °C, or is not known to be
            in metres.
    """
    require_rasterio()
    require_pyproj()
    if scene.temperature is None or THERMAL not in scene.modalities:
        raise ConfigError(
            f"{scene.name} has no temperatures in °C, which a map shows: give it a "
            f"temperature_bounds.json, or thermal photos in °C"
        )
    require_metres(scene)


def pixel_size_m(
    scene: Scene,
    maps: Sequence[DepthMap],
    options: MapOptions,
    extent: Float64[np.ndarray, "2"],
    most_px: int | None,
) -> float:
    """Side of a map's pixel, metres: as wanted, or the width of a photo's pixel on the surfaces
    (median), to two digits; that of the first modality, which has the finest pixels.

    Args:
        scene: with the cameras.
        maps: what the photos show, see ``survey``.
        options: the user's choices.
        extent: width and height of the map, metres.
        most_px: for its longer side; None without a limit.
    """
    focals = [float(camera.K[0, 0]) for camera in scene.train_cameras]
    size = options.pixel_size_m or float(f"{median_distance(maps) / np.median(focals):.1e}")
    return size if most_px is None else max(size, float(extent.max()) / most_px)


def vertical(scene: Scene) -> Float64[np.ndarray, "3"]:
    """The up direction of a scene, unit length.

    Raises:
        ConfigError: it is not known.
    """
    if scene.world.north:
        return UP_SNAP
    up = up_direction(scene)
    if up is None:
        raise ConfigError(
            "which way is up in this scene is not known, because its photos were not taken level: "
            "prepare it from photos with GPS"
        )
    return UP_SNAP if up @ UP_SNAP > np.cos(np.radians(3)) else up


def write_map(
    job: ExportJob,
    name: str,
    drawn: OrthographicMap,
    wkt: str,
    caption: Caption,
    facts: dict[str, Any],
) -> list[Any]:
    """Write ``NAME.tif`` with its sidecar and its style for QGIS, and ``NAME.png``; returns the
    paths."""
    grid = drawn.grid
    facts = job.surface_facts | {
        **facts,
        "bands": BANDS,
        "pixel_m": grid.pixel_m,
        "map_corner_in_scene": [round(float(x), 6) for x in grid.lower_left],
        "map_right_in_scene": [round(float(x), 9) for x in grid.axes[0]],
        "map_up_in_scene": [round(float(x), 9) for x in grid.axes[1]],
    }
    tags = dict(line.split(": ", 1) for line in comment_lines(facts))
    paths = described(write_geotiff(job.folder / f"{name}.tif", drawn, wkt, tags), facts)
    scale = map_scale(drawn, job.palette, job.range_c)
    style = write_style(job.folder / f"{name}.qml", scale)
    picture = map_picture(drawn, caption, scale)
    return [*paths, style, write_png(job.folder / f"{name}.png", picture)]


def summary(drawn: OrthographicMap) -> str:
    """Temperatures and photos of a map, in one line."""
    celsius = drawn.celsius[np.isfinite(drawn.celsius)]
    photos = drawn.bands[4][np.isfinite(drawn.celsius)]
    low, high = (number_text(float(each), 1) for each in (celsius.min(), celsius.max()))
    places = f"{np.median(photos):.0f} photos per place (median)"
    return f"{low} to {high} °C · {places} · {UNSEEN}"
