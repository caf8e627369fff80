"""The files of a prepared scene beside its images: cameras, split, start points and temperature
bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from mrgs.data.images import probe
from mrgs.data.lens import Lens
from mrgs.data.ply import write_points
from mrgs.data.transforms import (
    BOUNDS,
    POINTS,
    TRANSFORMS,
    frame_json,
    write_bounds,
    write_transforms,
)
from mrgs.errors import ConfigError, SceneError
from mrgs.prepare.contract import DevelopedView, Development, Georeference, Reconstruction
from mrgs.prepare.rig import RigCalibration
from mrgs.scene import PointCloud
from mrgs.system.atomic import remove


def write_scene(
    scene: Path,
    development: Development,
    reconstruction: Reconstruction,
    rig: RigCalibration | None,
    georeference: Georeference | None,
    *,
    eval_every: int,
    bounds: tuple[float, float] | None,
) -> None:
    """Write ``transforms.json``, ``sparse_pc.ply`` and ``temperature_bounds.json``, so that
    ``load_scene`` reads them.

    Only registered views are in the scene, in the order of the developed views. ``transforms.json``
    is written last, so that a folder whose making was cut off is not taken for a scene. Where an
    earlier call left points or bounds that this one has not, they are removed.

    Args:
        scene: the folder that holds the developed images.
        development: the images.
        reconstruction: poses and points in the scene's world, that is, after ``georeference`` has
            been applied.
        rig: the thermal camera, calibrated in that same world; None where one camera serves both
            images (if their sizes differ, both are taken to show the same field of view).
        georeference: noted in the file; None if nothing is known of scale and north.
        eval_every: every so-many-th view is held out, beginning with the first, as Mip-NeRF 360 and
            3DGS do; 0 holds none out.
        bounds: coldest and hottest temperature of the scale, °C (of black and white in grey
            images); None for the range of the registered views' images, rounded outwards to whole
            degrees, if they hold temperatures.

    Raises:
        ConfigError: ``eval_every`` would hold out every view.
        SceneError: no view is registered, or an image cannot be read.
        RunError: a file cannot be written.
    """
    if eval_every < 0 or eval_every == 1:
        raise ConfigError(
            f"eval_every = {eval_every} leaves no view to train on; give 0 for none, or 2 or more"
        )
    views = [view for view in development.views if view.name in reconstruction.viewmats]
    if not views:
        raise SceneError(
            f"{scene}: no view has a pose, so there is no scene to write; see which views failed "
            f"and why"
        )
    held_out = (
        {view.name for view in views[::eval_every]} if eval_every and len(views) > 1 else set()
    )
    _write_points(scene / POINTS, reconstruction.points)
    _write_bounds(scene / BOUNDS, views, bounds)
    write_transforms(
        scene / TRANSFORMS,
        [_frame(view, reconstruction, rig) for view in views],
        lens=reconstruction.lenses[views[0].name] if _one_lens(reconstruction) else None,
        thermal_lens=_thermal_lens(scene, views, reconstruction, rig),
        points=POINTS if len(reconstruction.points.positions) else None,
        split=_split(views, held_out, reconstruction),
        facts={**_georeference(georeference), **_thermal_offset(rig, georeference)},
    )


def _frame(
    view: DevelopedView, reconstruction: Reconstruction, rig: RigCalibration | None
) -> dict[str, Any]:
    """One view as nerfstudio describes it, with a thermal image."""
    viewmat, thermal_viewmat = reconstruction.viewmats[view.name], None
    if rig is not None:
        thermal_viewmat = rig.viewmat(_pair_index(rig, view.name), viewmat)
    return frame_json(
        viewmat,
        view.rgb if reconstruction.images == "rgb" else None,
        view.thermal,
        lens=None if _one_lens(reconstruction) else reconstruction.lenses[view.name],
        thermal_viewmat=thermal_viewmat,
    )


def _pair_index(rig: RigCalibration, name: str) -> int:
    """Index of the view among the rig's pairs.

    Raises:
        SceneError: the view was not among them.
    """
    for index, view in enumerate(rig.views):
        if view.name == name:
            return index
    raise SceneError(
        f"the view {name} has a pose but is not in the thermal camera's calibration; calibrate it "
        f"too"
    )


def _one_lens(reconstruction: Reconstruction) -> bool:
    return len({reconstruction.lenses[name] for name in reconstruction.viewmats}) == 1


def _thermal_lens(
    scene: Path,
    views: Sequence[DevelopedView],
    reconstruction: Reconstruction,
    rig: RigCalibration | None,
) -> Lens | None:
    """The thermal camera's intrinsics, if they differ from those of the posed images."""
    if rig is not None:
        return rig.lens
    if reconstruction.images == "thermal":
        return None
    info = probe(scene / views[0].thermal)
    lens = reconstruction.lenses[views[0].name]
    if (info.width, info.height) == (lens.width, lens.height):
        return None
    return _resized(lens, info.width, info.height)


def _thermal_offset(
    rig: RigCalibration | None, georeference: Georeference | None
) -> dict[str, Any]:
    """The rig's motion in metres, where these are known, to be given for other photos of the same
    two cameras."""
    if rig is None or georeference is None or not georeference.metric:
        return {}
    return {"thermal_from_rgb_m": rig.thermal_from_rgb.tolist()}


def _resized(lens: Lens, width: int, height: int) -> Lens:
    """The same rays on another pixel grid."""
    x, y = width / lens.width, height / lens.height
    return Lens(
        width,
        height,
        lens.fx * x,
        lens.fy * y,
        lens.cx * x,
        lens.cy * y,
        lens.radial,
        lens.tangential,
        lens.fisheye,
    )


def _split(
    views: Sequence[DevelopedView], held_out: set[str], reconstruction: Reconstruction
) -> tuple[list[str], list[str]]:
    """Paths of the training and of the evaluation images."""
    paths: dict[bool, list[str]] = {False: [], True: []}
    for view in views:
        path = view.rgb if reconstruction.images == "rgb" else view.thermal
        assert path is not None  # it has a pose, and the poses are those of these images
        paths[view.name in held_out].append(path)
    return paths[False], paths[True]


def _georeference(georeference: Georeference | None) -> dict[str, Any]:
    """What other programs may want to know of the world; this project's reader does not need it."""
    if georeference is None:
        return {}
    origin = georeference.origin
    facts: dict[str, Any] = {
        "units": "metres" if georeference.metric else "arbitrary",
        "axes": "east north up" if georeference.north else "arbitrary",
    }
    if origin is not None:
        facts["origin"] = {
            "latitude_deg": origin.latitude_deg,
            "longitude_deg": origin.longitude_deg,
            "altitude_m": origin.altitude_m,
        }
    return {"georeference": facts}


def _write_bounds(
    path: Path, views: Sequence[DevelopedView], given: tuple[float, float] | None
) -> None:
    """ThermoScenes' file; none where no temperature is known."""
    ranges = [view.range_c for view in views if view.range_c is not None]
    if given is None and ranges:
        low, high = (
            math.floor(min(low for low, _ in ranges)),
            math.ceil(max(high for _, high in ranges)),
        )
        given = float(low), float(max(high, low + 1))
    if given is None:
        remove(path)  # what an earlier call wrote would be wrong now
        return
    write_bounds(path, *given)


def _write_points(path: Path, points: PointCloud) -> None:
    """Coloured points as a binary PLY file."""
    if not len(points.positions):
        remove(path)  # what an earlier call wrote would be wrong now
        return
    colors = (points.colors.clamp(0, 1) * 255).round().to(torch.uint8)
    write_points(path, points.positions.numpy(), colors.numpy())
