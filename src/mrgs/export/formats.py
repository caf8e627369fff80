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


def _format(name: str, files: str, writer: str = "", required: str = "", **options: Any) -> Format:
    """A format; writer, by default ``NAME:export``, and requirement are ``MODULE:FUNCTION``."""
    if required:
        options["require"] = imported(*f"mrgs.export.{required}".split(":"))
    write = imported(*f"mrgs.export.{writer or f'{name}:export'}".split(":"))
    return Format(name, files, write, **options)


_FORMATS = (
    _format("ply", "splats as 3DGS writes them, and all modalities in one file"),
    _format("spz", "splats, compressed"),
    _format("glb", "splats as glTF with KHR_gaussian_splatting"),
    _format("points", "the opaque splats as points with colour and temperature"),
    _format("las", "the same points", "points:export_las", "points:require_las"),
    _format("mesh", "triangles with colour and temperature"),
    _format("cameras", "transforms.json, a COLMAP model and the undistorted images"),
    _format("page", "one HTML file", "page.write:export"),
    _format("marks", "marks for GIS and CAD: GeoJSON, GeoPackage, DXF, KML; not part of all",
            required="marks:require_marks", in_all=False),
    *(
        _format(name, f"{what} in °C: GeoTIFF, DXF, PNG; not part of all", f"maps:export_{name}",
                f"maps:require_{name}", in_all=False)
        for name, what in (("ortho", "map from above"), ("elevation", "map of a façade"))
    ),
)  # fmt: skip

FORMATS: dict[str, Format] = {each.name: each for each in _FORMATS}
"""All formats by name, in the order of the help."""
