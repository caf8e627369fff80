"""A map as a GeoTIFF: float32 bands with names and units, NaN where nothing is known."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

from mrgs.export.maps.draw import BANDS, OrthographicMap
from mrgs.system.atomic import replacing
from mrgs.system.optional import optional_package

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
        path: of the file.
        drawn: the map.
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
