"""A map's files: the GeoTIFF with its sidecar and its style for QGIS, and the picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from mrgs.errors import ConfigError
from mrgs.export.crs import require_metres, require_pyproj
from mrgs.export.job import ExportJob, described
from mrgs.export.maps.draw import BANDS, OrthographicMap
from mrgs.export.maps.options import MapOptions
from mrgs.export.maps.picture import Caption, map_picture, map_scale
from mrgs.export.maps.surfaces import median_distance
from mrgs.export.sidecar import UP_SNAP, comment_lines, up_direction
from mrgs.pictures.drawing import Scale
from mrgs.pictures.files import write_png
from mrgs.pictures.numbers import number_text
from mrgs.pictures.palette import palette_table
from mrgs.scene import THERMAL, Scene
from mrgs.scene.depth_map import DepthMap
from mrgs.system.atomic import replacing, write_text
from mrgs.system.lazy import optional_package

TILE_PX = 256


def require_rasterio() -> ModuleType:
    """Import the package rasterio.

    Raises:
        ConfigError: it is not installed.
    """
    return optional_package("rasterio", "maps", "export")


def write_geotiff(path: Path, drawn: OrthographicMap, wkt: str, tags: Mapping[str, str]) -> Path:
    """Write the bands of a map, tiled and compressed without loss; returns the path.

    Args:
        wkt: its coordinate reference system as well-known text.
        tags: facts by name.

    Raises:
        ConfigError: rasterio is not installed.
        RunError: the file cannot be written.
    """
    rasterio = require_rasterio()
    grid = drawn.grid
    profile = {
        "driver": "GTiff", "dtype": "float32", "nodata": float("nan"), "count": len(BANDS),
        "width": grid.width, "height": grid.height,
        "crs": rasterio.crs.CRS.from_wkt(wkt),
        "transform": rasterio.Affine(grid.pixel_m, 0.0, grid.left, 0.0, -grid.pixel_m, grid.top),
        "tiled": True, "blockxsize": TILE_PX, "blockysize": TILE_PX,
        "compress": "deflate", "predictor": 3, "BIGTIFF": "IF_SAFER",
    }  # fmt: skip
    color = rasterio.enums.ColorInterp
    with replacing(path) as temporary:
        try:
            with rasterio.open(temporary, "w", **profile) as file:
                file.write(drawn.bands)
                file.update_tags(**tags)
                colors = {name: color[name] for name in ("red", "green", "blue")}
                file.colorinterp = [colors.get(name, color.undefined) for name in BANDS]
                for number, (name, unit) in enumerate(BANDS.items(), start=1):
                    file.set_band_description(number, name)
                    file.set_band_unit(number, unit)
        except rasterio.errors.RasterioError as error:
            raise OSError(0, f"GDAL: {error}") from error
    return path


STOPS = 16
"""Colours between which QGIS interpolates."""


def write_style(path: Path, scale: Scale) -> Path:
    """Write the style of a map, which QGIS applies by its name: ``NAME.qml`` beside ``NAME.tif``;
    returns the path.

    Raises:
        RunError: the file cannot be written.
    """
    low, high = min(scale.low, scale.high), max(scale.low, scale.high)
    document = ElementTree.Element("qgis", styleCategories="Symbology")
    renderer = ElementTree.SubElement(
        ElementTree.SubElement(document, "pipe"),
        "rasterrenderer",
        type="singlebandpseudocolor", band="1", opacity="1", alphaBand="-1",
        classificationMin=f"{low:.4f}", classificationMax=f"{high:.4f}",
    )  # fmt: skip
    ramp = ElementTree.SubElement(
        ElementTree.SubElement(renderer, "rastershader"),
        "colorrampshader",
        colorRampType="INTERPOLATED", classificationMode="1", clip="0",
        minimumValue=f"{low:.4f}", maximumValue=f"{high:.4f}",
    )  # fmt: skip
    shares = np.linspace(0, 1, STOPS)
    values = scale.low + shares * (scale.high - scale.low)
    colors = palette_table(scale.palette)[np.rint(255 * shares).astype(int)]
    for value, color in sorted(zip(values.tolist(), colors.tolist(), strict=True)):
        ElementTree.SubElement(
            ramp,
            "item",
            value=f"{value:.4f}", label=f"{number_text(value, 1)} {scale.unit}", alpha="255",
            color="#" + bytes(color).hex(),
        )  # fmt: skip
    ElementTree.indent(document)
    return write_text(path, ElementTree.tostring(document, encoding="unicode") + "\n")


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
        maps: what the photos show, see ``survey``.
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
