"""The splats on surfaces as points, with what the training cameras see there.

A splat's own temperature is what it adds to a blend, which may be far from any surface's. What a
camera sees is what was compared with the photos.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from mrgs.errors import RunError
from mrgs.export.splats import to_bytes, value_names
from mrgs.maps.surfaces import NO_SURFACE
from mrgs.pictures.files import to_array
from mrgs.pictures.values import in_unit
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB, Scene
from mrgs.scene.depth_map import MAX_STEP, MAX_WIDTH_PX, SURFACE_DEPTH, DepthMap, carry_over

COLORS = ("red", "green", "blue")
"""What files call the channels of RGB."""


def depth_maps(baked: BakedModel, scene: Scene) -> list[DepthMap]:
    """The renderings of the training cameras, of enough to see every place, with the channels of
    all modalities of the model one behind the other, temperatures in °C where known. The depth is
    that of the first modality of which the scene has photos, infinite where the sky is seen.
    RunError if no pixel is opaque enough to have one."""
    maps, surface = [], scene.modalities[0]
    for camera in (view.camera.at_most(MAX_WIDTH_PX) for view in scene.survey_views()):
        rendering = baked.render(camera, surface)
        depth = rendering.surface_depth(surface, max_step=MAX_STEP)
        distant = to_array(scene.reach.without_background(camera, depth))
        images = [
            to_array(in_unit(modality, blend.image, baked.temperature))
            for modality, blend in rendering.items()
        ]
        maps.append(DepthMap(camera, distant, np.concatenate(images, axis=2)))
    if not any(np.isfinite(item.depth).any() for item in maps):
        raise RunError(NO_SURFACE)
    return maps


def value_columns(
    baked: BakedModel, values: Float32[np.ndarray, "n c"]
) -> dict[str, Float32[np.ndarray, " n"] | UInt8[np.ndarray, " n"]]:
    """The columns of a file for values that were carried over: ``red``, ``green`` and ``blue`` as
    bytes, the other modalities by ``value_names``."""
    columns: dict[str, np.ndarray] = {}
    ends = np.cumsum([modality.channels for modality in baked.modalities])
    for modality, part in zip(baked.modalities, np.split(values, ends[:-1], axis=1), strict=True):
        names = COLORS if modality == RGB else value_names(baked, modality)
        shown = to_bytes(part) if modality == RGB else part
        columns |= {name: shown[:, channel] for channel, name in enumerate(names)}
    return columns


MIN_OPACITY = 0.3
"""A splat becomes a point if an opacity reaches this: fainter ones are haze off the surfaces."""

Columns: TypeAlias = Mapping[str, Float32[np.ndarray, " m"] | UInt8[np.ndarray, " m"]]
"""Colours, temperatures and other values by their names in files."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """M points with what they carry into a file: values by their names there, see
    ``value_columns``, and the largest opacity of all modalities."""

    positions: Float32[np.ndarray, "m 3"]
    columns: Columns
    opacities: Float32[np.ndarray, " m"]


def surface_points(baked: BakedModel, scene: Scene) -> SurfacePoints:
    """The centres of the splats that are opaque in any modality and on a surface that a training
    camera sees, with what the cameras see there, see ``depth_maps``. RunError if there is none."""
    opacities = to_array(torch.stack(list(baked.opacities.values())).amax(dim=0))
    rows = np.flatnonzero(opacities >= MIN_OPACITY)
    if not len(rows):
        raise RunError(f"no splat has an opacity of {MIN_OPACITY} or more: train it longer")
    positions = to_array(baked.means)[rows]
    values, cameras = carry_over(depth_maps(baked, scene), positions, 0.0, SURFACE_DEPTH)
    seen = cameras > 0
    if not seen.any():
        raise RunError(
            "no opaque splat is on a surface that a camera sees: there are no points, train longer"
        )
    columns = value_columns(baked, values[seen])
    return SurfacePoints(positions[seen], columns, opacities[rows[seen]])
