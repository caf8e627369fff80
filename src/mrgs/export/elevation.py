"""``elevation.tif``: a façade from the front in °C, as a GeoTIFF, and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from mrgs.export.crs import local_wkt
from mrgs.export.job import ExportJob
from mrgs.export.maps.draw import OrthographicMap, draw_map
from mrgs.export.maps.facade import Facade, find_facade, given_facade, surfaces_of
from mrgs.export.maps.grid import MapGrid
from mrgs.export.maps.options import MapOptions
from mrgs.export.maps.photos import survey
from mrgs.export.maps.picture import Caption
from mrgs.export.maps.write import pixel_size_m, require_map, summary, vertical, write_map
from mrgs.export.sidecar import up_direction
from mrgs.marks.regions import Regions
from mrgs.marks.uncertainty import UncertaintyMeter
from mrgs.runs.baked import BakedModel
from mrgs.scene import Scene
from mrgs.scene.depth_map import DepthMap

COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


def export(job: ExportJob) -> list[Path]:
    """Write ``elevation.tif`` with its sidecar, and ``elevation.png``.

    Its coordinates are metres to the right and upwards from the lower left corner of the map; where
    that lies in the scene is in the sidecar.
    """
    drawn, facade = facade_map(job.baked, job.scene, job.maps, job.uncertainty, regions=job.regions)
    caption, facts = caption_and_facts(job.scene, drawn, facade)
    return write_map(job, "elevation", drawn, local_wkt(f"{job.scene.name} façade"), caption, facts)


def caption_and_facts(
    scene: Scene, drawn: OrthographicMap, facade: Facade
) -> tuple[Caption, dict[str, Any]]:
    """What is said of a façade in its picture, and in its sidecar."""
    grid = drawn.grid
    facts = {
        "map": "orthographic, of a façade",
        "map_crs": "metres to the right and upwards from the map's lower left corner",
    }
    facing = ""
    if scene.world.north:
        azimuth = float(np.degrees(np.arctan2(facade.axes[2, 0], facade.axes[2, 1])) % 360)
        facts |= {"faces_azimuth_deg": f"{azimuth:.1f}"}
        facing = f" · faces {COMPASS[round(azimuth / 45) % 8]} ({azimuth:.0f}°)"
    size = f"{grid.width * grid.pixel_m:.4g} × {grid.height * grid.pixel_m:.4g} m"
    caption = Caption(
        f"{scene.name}: facade temperatures",
        f"{size}{facing} · {grid.pixel_m * 100:g} cm per pixel",
        summary(drawn),
        None,
    )
    return caption, facts


def require(scene: Scene, crs: str | None = None) -> None:
    """Check that a map can be written, see ``require_map``; it lies in no CRS."""
    require_map(scene)


def facade_map(
    baked: BakedModel,
    scene: Scene,
    options: MapOptions,
    uncertainty: UncertaintyMeter | None = None,
    most_px: int | None = None,
    regions: Regions | None = None,
) -> tuple[OrthographicMap, Facade]:
    """The map of a façade, and where that lies.

    Args:
        baked: the model, as the photos have it.
        scene: that it was trained on.
        options: plane and pixels.
        uncertainty: of the temperatures; None leaves its band empty.
        most_px: for the longer side of the map; None without a limit.
        regions: surfaces with an emissivity of their own, which the map shows corrected.

    Raises:
        ConfigError: which way is up is not known, or the map has too many pixels.
        RunError: no façade was found.
        SceneError: a photo cannot be read.
    """
    maps = survey(baked, scene)
    facade = _facade(scene, options, maps)
    extent = (facade.high - facade.low)[:2]
    grid = _grid(facade, pixel_size_m(scene, maps, options, extent, most_px))
    return draw_map(baked, scene, maps, grid, uncertainty, regions=regions), facade


def _facade(scene: Scene, options: MapOptions, maps: Sequence[DepthMap]) -> Facade:
    surfaces = surfaces_of(maps)
    eye = torch.stack([item.camera.position for item in maps]).mean(dim=0).numpy()
    if options.plane is None:
        return find_facade(surfaces, vertical(scene), eye)
    return given_facade(surfaces, options.points, up_direction(scene), eye)


def _grid(facade: Facade, pixel_m: float) -> MapGrid:
    """Map coordinates begin at the lower left corner."""
    low, high = facade.low, facade.high
    width, height = (max(int(np.ceil(size / pixel_m)), 1) for size in (high - low)[:2])
    offset: Float64[np.ndarray, "2"] = -low[:2]
    slab = float(low[2]), float(high[2])
    return MapGrid(facade.axes, 1.0, offset, 0.0, height * pixel_m, pixel_m, width, height, slab)
