"""The files of a prepared scene besides images: cameras, split, start points and bounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from mrgs.data.ply import write_points
from mrgs.data.transforms import (
    BOUNDS,
    POINTS,
    RECORD,
    TRANSFORMS,
    frame_json,
    world_json,
    write_bounds,
    write_transforms,
)
from mrgs.errors import SceneError
from mrgs.prepare.contract import ConvertedView, Reconstruction
from mrgs.prepare.rig.contract import RigCalibration
from mrgs.prepare.thermal_camera import EXTRINSICS
from mrgs.prepare.work import Work
from mrgs.scene import THERMAL, Modality, TemperatureRange
from mrgs.scene.lens import Lens
from mrgs.system.atomic import remove


def write_scene(work: Work) -> None:
    """Write ``transforms.json``, ``sparse_pc.ply`` and ``temperature_bounds.json``, so that
    ``load_scene`` reads them.

    Only views with a pose are in the scene, in the order of the converted views. The transforms are
    written last, so that an unfinished folder is not read as a scene. Points and bounds of an
    earlier call are removed if there are none now.

    Every ``eval_every``-th view is held out, beginning with the first, as in Mip-NeRF 360 and 3DGS.
    Bounds that are not given are the range of the views' temperatures, rounded outwards to whole
    degrees. Without a rig one camera took both images; if their sizes differ, both are taken to
    show the same field of view. SceneError if no view has a pose, or an image cannot be read;
    RunError if a file cannot be written."""
    scene, posed, rig, eval_every = work.scene, work.posed, work.rig, work.options.eval_every
    views = [view for view in work.images.views if view.name in posed.viewmats]
    if not views:
        raise SceneError(
            f"{scene}: no view has a pose, so there is no scene to write; see which views failed "
            f"and why"
        )
    held_out: set[str] = set()
    if eval_every and len(views) > 1:
        held_out = {view.name for view in views[::eval_every]}
    files = {view.name: view.images[posed.images].file for view in views}
    split = (
        [file for name, file in files.items() if name not in held_out],
        [file for name, file in files.items() if name in held_out],
    )
    points = posed.points
    if len(points.positions):
        colors = (points.colors.clamp(0, 1) * 255).round().to(torch.uint8)
        write_points(scene / POINTS, points.positions.numpy(), colors.numpy())
    else:
        remove(scene / POINTS)  # of an earlier call
    bounds_c = work.options.overrides.bounds_c
    ranges = [view.range_c for view in views if view.range_c is not None]
    if bounds_c is None and ranges:
        low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
        around = TemperatureRange.around(low, high)
        bounds_c = around.min_c, around.max_c
    if bounds_c is not None:
        write_bounds(scene / BOUNDS, *bounds_c)
    else:
        remove(scene / BOUNDS)  # of an earlier call
    write_transforms(
        scene / TRANSFORMS,
        [_frame(view, posed, rig) for view in views],
        lens=posed.lenses[views[0].name] if _one_lens(posed) else None,
        lenses=_thermal_lens(views, posed, rig),
        points=POINTS if len(points.positions) else None,
        split=split,
        facts={
            **({} if work.georeference is None else world_json(work.georeference.world)),
            **({EXTRINSICS: rig.extrinsics.tolist()} if rig and work.metric else {}),
        },
    )


def _frame(
    view: ConvertedView, reconstruction: Reconstruction, rig: RigCalibration | None
) -> dict[str, Any]:
    """One view as nerfstudio describes it, with a thermal image."""
    viewmat, viewmats = reconstruction.viewmats[view.name], {}
    if rig is not None:
        viewmats[THERMAL] = rig.viewmat(view.name, viewmat)
    frame = frame_json(
        viewmat,
        None if reconstruction.images == THERMAL else view.images[reconstruction.images].file,
        {THERMAL: view.images[THERMAL].file},
        lens=None if _one_lens(reconstruction) else reconstruction.lenses[view.name],
        viewmats=viewmats,
    )
    return frame | {f"{THERMAL}_{RECORD}": view.facts.record.to_json()}


def _one_lens(reconstruction: Reconstruction) -> bool:
    return len({reconstruction.lenses[name] for name in reconstruction.viewmats}) == 1


def _thermal_lens(
    views: Sequence[ConvertedView], reconstruction: Reconstruction, rig: RigCalibration | None
) -> dict[Modality, Lens]:
    """The thermal camera's intrinsics, if they differ from those of the posed images."""
    if rig is not None:
        return {THERMAL: rig.lens}
    if reconstruction.images == THERMAL:
        return {}
    size, lens = views[0].images[THERMAL].size, reconstruction.lenses[views[0].name]
    return {} if size == (lens.width, lens.height) else {THERMAL: lens.resized(*size)}
