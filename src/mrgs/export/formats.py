"""The formats of an export, by name.

To add one, write a module with a function ``export(job: ExportJob) -> list[Path]`` and add a line
to ``_FORMATS``. Nothing is imported for a format before it is used, so that the command line can
list them all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mrgs.runs.registry import imported


@dataclass(frozen=True)
class Format:
    """An export format.

    Attributes:
        files: one line for the help: the files that are written.
        export: writes the files of an ``ExportJob``; returns their paths.
        require: given a scene and the wanted CRS (None for UTM), raises ConfigError, before
            anything is written, if the format cannot be written.
        in_all: whether an export of all formats includes it; maps are not of use to every scene.
    """

    name: str
    files: str
    export: Callable[..., Any]
    require: Callable[..., Any] = lambda scene, crs=None: None
    in_all: bool = True


def _format(name: str, files: str, writer: str = "", **options: Any) -> Format:
    """The format whose writer is ``export`` of the module of its name, or ``MODULE:FUNCTION``."""
    module, _, function = (writer or f"{name}:export").partition(":")
    return Format(name, files, imported(f"mrgs.export.{module}", function), **options)


_FORMATS = (
    _format("ply", "splats as 3DGS writes them, and all modalities in one file"),
    _format("spz", "splats, compressed"),
    _format("glb", "splats as glTF with KHR_gaussian_splatting"),
    _format("points", "the opaque splats as points with colour and temperature"),
    _format(
        "las",
        "the same points",
        "points:export_las",
        require=imported("mrgs.export.points", "require_las"),
    ),
    _format("mesh", "triangles with colour and temperature"),
    _format("cameras", "transforms.json, a COLMAP model and the undistorted images"),
    _format("page", "one HTML file", "page.write:export"),
    _format(
        "ortho",
        "map from above in °C: GeoTIFF and PNG; not part of all",
        "maps:export_ortho",
        require=imported("mrgs.export.maps", "require_ortho"),
        in_all=False,
    ),
    _format(
        "elevation",
        "map of a façade in °C: GeoTIFF and PNG; not part of all",
        "maps:export_elevation",
        require=imported("mrgs.export.maps", "require_elevation"),
        in_all=False,
    ),
)

FORMATS: dict[str, Format] = {each.name: each for each in _FORMATS}
"""By name, in the order of the help."""
