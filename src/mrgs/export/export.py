"""A trained run, or its baked model, into a folder of files for other programs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float64

from mrgs.errors import ConfigError, MrgsWarning
from mrgs.export.cameras import write_cameras
from mrgs.export.glb import write_glb
from mrgs.export.las import require_laspy, write_las
from mrgs.export.loss import BakingLoss, baking_loss_db
from mrgs.export.mesh import build_mesh, write_mesh_ply
from mrgs.export.page import MODALITIES, Modality, write_page
from mrgs.export.ply import write_rgb_thermal_ply, write_splat_ply
from mrgs.export.points import TemperaturePoints, temperature_points, write_points_ply
from mrgs.export.sidecar import comment_lines, facts_of, thermal_facts, up_direction, write_sidecar
from mrgs.export.splat import write_splat
from mrgs.export.splats import (
    Splats,
    ThermalScale,
    require_exportable,
    rgb_splats,
    shown_temperatures,
    temperature_name,
    thermal_scale,
    thermal_splats,
    without_directions,
)
from mrgs.export.spz import write_spz
from mrgs.pictures.palette import PaletteName
from mrgs.runs.baked import BakedModel, bake
from mrgs.runs.open import Run
from mrgs.scene import Scene

Format = Literal["ply", "spz", "glb", "splat", "points", "las", "mesh", "cameras", "page"]
FORMATS: tuple[Format, ...] = get_args(Format)


@dataclass(frozen=True, eq=False)
class _Job:
    """What every writer of an export needs."""

    baked: BakedModel
    scene: Scene
    folder: Path
    scale: ThermalScale
    up: Float64[np.ndarray, "3"] | None
    facts: dict[str, Any]
    run: Run | None
    loss: BakingLoss | None
    palette: PaletteName
    limits_c: tuple[float, float] | None

    @cached_property
    def flat(self) -> Splats:
        """The RGB splats without view dependence."""
        return without_directions(self.baked, self.scene.train_cameras)

    @cached_property
    def points(self) -> TemperaturePoints:
        """The splats on surfaces."""
        return temperature_points(self.baked, self.scene)

    @property
    def surface_facts(self) -> dict[str, Any]:
        """What holds for files whose temperatures are not those of single splats."""
        return self.facts | {
            "temperature": self.facts["temperature"] | {"of": "the surface, as the cameras see it"}
        }

    def flat_facts(self) -> dict[str, Any]:
        """What a format without view dependence loses."""
        if self.run is None:
            return {"view_dependence": "left out"}
        sh = torch.zeros_like(self.baked.sh)
        sh[:, :1] = torch.from_numpy(self.flat.sh).to(sh)
        loss = baking_loss_db(self.run, replace(self.baked, sh=sh), self.scene)
        return {
            "view_dependence": "left out",
            "baking_loss_db": {"rgb": loss.rgb_db, "thermal": loss.thermal_db},
        }


def export(
    model: Run | BakedModel,
    scene: Scene,
    format: Format | Literal["all"],
    folder: Path,
    palette: PaletteName = "inferno",
    limits_c: tuple[float, float] | None = None,
    on_baked: Callable[[BakingLoss], None] | None = None,
) -> list[Path]:
    """Write a model in one format, or in all, into a folder; returns the paths.

    ===========  ================================================================================
    ply          ``rgb.ply``, ``thermal.ply`` (colour-mapped), ``rgb_thermal.ply`` (with °C)
    spz          ``rgb.spz``, ``thermal.spz``
    glb          ``rgb.glb``, ``thermal.glb``: glTF with KHR_gaussian_splatting and temperatures
    splat        ``rgb.splat``, ``thermal.splat``: no view dependence
    points       ``points.ply``: the opaque splats as points with colour and temperature
    las          ``points.las``: the same; needs the extra ``export``
    mesh         ``mesh.ply``: triangles with colour and temperature
    cameras      ``cameras/``: transforms.json, a COLMAP model, the undistorted images
    page         ``page.html``: everything in one file for a browser, which needs nothing else
    ===========  ================================================================================

    Beside each file but those of ``cameras`` and ``page``, ``NAME.SUFFIX.json`` says units, axes,
    temperature range and baking loss.

    Args:
        model: a run, which is baked here, or a model that is baked already (its baking loss is then
            not measured).
        scene: what it was trained on.
        format: one of ``FORMATS``, or ``all``: every format whose packages are installed.
        folder: made if need be; files of these names are replaced.
        palette: colours of the colour-mapped files.
        limits_c: °C of the palette's first and last colour; None takes the scene's whole range.
        on_baked: told what the baking of a run costs.

    Raises:
        ConfigError: an unknown format, limits that cannot be used, or an extra that is not
            installed.
        RunError: the model cannot be exported, or a file cannot be written.
        SceneError: a photo cannot be read.
    """
    if format not in (*FORMATS, "all"):
        raise ConfigError(
            f"unknown export format {format!r}: choose one of {', '.join(FORMATS)}, or all"
        )
    if format == "las":
        require_laspy()
    job = _job(model, scene, folder, palette, limits_c)
    if job.loss is not None and on_baked is not None:
        on_baked(job.loss)
    chosen = _available() if format == "all" else [format]
    return [path for name in chosen for path in _WRITERS[name](job)]


def _job(
    model: Run | BakedModel,
    scene: Scene,
    folder: Path,
    palette: PaletteName,
    limits_c: tuple[float, float] | None,
) -> _Job:
    run = model if isinstance(model, Run) else None
    baked = (
        model
        if isinstance(model, BakedModel)
        else bake(model.model, scene.train_cameras, model.temperature)
    )
    require_exportable(baked)
    scale, up = thermal_scale(baked, palette, limits_c), up_direction(scene)
    loss = None if run is None else baking_loss_db(run, baked, scene)
    return _Job(
        baked,
        scene,
        folder,
        scale,
        up,
        facts_of(baked, scene, up, loss),
        run,
        loss,
        palette,
        limits_c,
    )


def _available() -> list[Format]:
    """The formats whose packages are installed."""
    try:
        require_laspy()
    except ConfigError as error:
        warnings.warn(f"points.las is left out: {error}", MrgsWarning, stacklevel=3)
        return [name for name in FORMATS if name != "las"]
    return list(FORMATS)


def _variants(job: _Job, flat: bool = False) -> Iterator[tuple[str, Splats, dict[str, Any]]]:
    """File stem, splats and facts of the modalities that the scene has; ``flat`` for formats
    without directions."""
    if job.scene.has_rgb:
        yield "rgb", job.flat if flat else rgb_splats(job.baked), dict(job.facts)
    if job.scene.has_thermal:
        yield (
            "thermal",
            thermal_splats(job.baked, job.scale),
            job.facts | thermal_facts(job.scale, job.baked),
        )


def _write_ply(job: _Job) -> list[Path]:
    paths = []
    for name, splats, facts in _variants(job):
        paths += _described(
            write_splat_ply(job.folder / f"{name}.ply", splats, comment_lines(facts)), facts
        )
    both = write_rgb_thermal_ply(
        job.folder / "rgb_thermal.ply", job.baked, comment_lines(job.facts)
    )
    return [*paths, *_described(both, job.facts)]


def _write_spz(job: _Job) -> list[Path]:
    paths = []
    for name, splats, facts in _variants(job):
        facts["frame"] += ", turned by 180° about x, as SPZ's axes demand and its readers undo"
        paths += _described(write_spz(job.folder / f"{name}.spz", splats), facts)
    return paths


def _write_glb(job: _Job) -> list[Path]:
    temperatures = {temperature_name(job.baked): shown_temperatures(job.baked)}
    paths = []
    for name, splats, facts in _variants(job):
        if job.up is not None:
            facts["frame"] += "; the node turns its up direction to +y"
        paths += _described(
            write_glb(job.folder / f"{name}.glb", splats, job.up, facts, temperatures), facts
        )
    return paths


def _write_splat(job: _Job) -> list[Path]:
    paths = []
    for name, splats, facts in _variants(job, flat=True):
        if name == "rgb":
            facts |= job.flat_facts()
        paths += _described(write_splat(job.folder / f"{name}.splat", splats), facts)
    return paths


def _write_points(job: _Job) -> list[Path]:
    return _described(
        write_points_ply(job.folder / "points.ply", job.points, comment_lines(job.surface_facts)),
        job.surface_facts,
    )


def _write_las(job: _Job) -> list[Path]:
    return _described(write_las(job.folder / "points.las", job.points), job.surface_facts)


def _write_mesh(job: _Job) -> list[Path]:
    mesh = build_mesh(job.baked, job.scene)
    return _described(
        write_mesh_ply(job.folder / "mesh.ply", mesh, job.baked, comment_lines(job.surface_facts)),
        {**job.surface_facts, "vertices": len(mesh.vertices), "faces": len(mesh.faces)},
    )


def _write_cameras(job: _Job) -> list[Path]:
    return write_cameras(job.folder / "cameras", job.scene)


def _write_page(job: _Job) -> list[Path]:
    views = [*job.scene.eval, *job.scene.train]
    modalities: list[Modality] = [name for name in MODALITIES if getattr(job.scene, f"has_{name}")]
    path = write_page(
        job.baked,
        {view.name: view.cameras[0] for view in views},
        f"{job.scene.name}: thermal model",
        job.folder / "page.html",
        palette=job.palette,
        range_c=job.limits_c,
        notes=job.scene.notes,
        modalities=modalities,
    )
    return [path]


def _described(path: Path, facts: Mapping[str, Any]) -> list[Path]:
    return [path, write_sidecar(path, facts)]


_WRITERS: dict[Format, Callable[[_Job], list[Path]]] = {
    "ply": _write_ply,
    "spz": _write_spz,
    "glb": _write_glb,
    "splat": _write_splat,
    "points": _write_points,
    "las": _write_las,
    "mesh": _write_mesh,
    "cameras": _write_cameras,
    "page": _write_page,
}
