"""``elevation.tif``: a façade from the front in °C, as a GeoTIFF, and as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from mrgs.export.crs import local_wkt
from mrgs.export.job import ExportJob
from mrgs.export.maps.draw import draw_map
from mrgs.export.maps.facade import Facade, find_facade, given_facade, surfaces_of
from mrgs.export.maps.grid import MapGrid
from mrgs.export.maps.photos import survey
from mrgs.export.maps.picture import Caption
from mrgs.export.maps.write import default_pixel_m, require_map, summary, vertical, write_map
from mrgs.scene import Scene
from mrgs.scene.depth_map import DepthMap

COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


def export(job: ExportJob) -> list[Path]:
    """Write ``elevation.tif`` with its sidecar, and ``elevation.png``.

    Its coordinates are metres to the right and upwards from the lower left corner of the map; where
    that lies in the scene is in the sidecar.
    """
    maps = survey(job.baked, job.scene)
    facade = _facade(job, maps)
    grid = _grid(facade, job.maps.pixel_size_m or default_pixel_m(job, maps))
    drawn = draw_map(job.baked, job.scene, maps, grid, job.uncertainty)
    facts = {
        "map": "orthographic, of a façade",
        "map_crs": "metres to the right and upwards from the map's lower left corner",
    }
    facing = ""
    if job.scene.world.north:
        azimuth = float(np.degrees(np.arctan2(facade.axes[2, 0], facade.axes[2, 1])) % 360)
        facts |= {"faces_azimuth_deg": f"{azimuth:.1f}"}
        facing = f" · faces {COMPASS[round(azimuth / 45) % 8]} ({azimuth:.0f}°)"
    size = f"{grid.width * grid.pixel_m:.4g} × {grid.height * grid.pixel_m:.4g} m"
    caption = Caption(
        f"{job.scene.name}: facade temperatures",
        f"{size}{facing} · {grid.pixel_m * 100:g} cm per pixel",
        summary(drawn),
        False,
    )
    return write_map(job, "elevation", drawn, local_wkt(f"{job.scene.name} façade"), caption, facts)


def require(scene: Scene) -> None:
    """Check that a map can be written, see ``require_map``."""
    require_map(scene)


def _facade(job: ExportJob, maps: list[DepthMap]) -> Facade:
    surfaces = surfaces_of(maps)
    eye = torch.stack([item.camera.position for item in maps]).mean(dim=0).numpy()
    if job.maps.plane is None:
        return find_facade(surfaces, vertical(job), eye)
    return given_facade(surfaces, job.maps.points, job.up, eye)


def _grid(facade: Facade, pixel_m: float) -> MapGrid:
    """Map coordinates begin at the lower left corner."""
    low, high = facade.low, facade.high
    width, height = (max(int(np.ceil(size / pixel_m)), 1) for size in (high - low)[:2])
    offset: Float64[np.ndarray, "2"] = -low[:2]
    slab = float(low[2]), float(high[2])
    return MapGrid(facade.axes, 1.0, offset, 0.0, height * pixel_m, pixel_m, width, height, slab)
