"""What the training cameras see of a model: depths, colours, temperatures and other values, carried
over to points in space.

A splat's own temperature is what it adds to a blend, which may be far from any surface's. What a
camera sees is what was compared with the photos.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from mrgs.errors import RunError
from mrgs.export.fusion import DepthMap, visible
from mrgs.export.splats import to_bytes, to_float32, value_names
from mrgs.pictures.values import in_unit
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB, Camera, Modality, Reach, Scene, evenly_spaced

COLORS = ("red", "green", "blue")
"""What files call the channels of RGB."""

MAX_VIEWS = 64
MAX_WIDTH_PX = 480
"""At most so many training cameras, spread evenly, and so many pixels across, are rendered: memory
and time."""

MIN_ALPHA = 0.5
"""A pixel that lets through more light than this has no depth."""

MAX_STEP = 0.05
"""A pixel whose depth differs by more than this share within its neighbours lies on an outline: it
has no depth."""


def depth_maps(baked: BakedModel, scene: Scene) -> list[DepthMap]:
    """The renderings of the training cameras; the channels are those of the model's modalities, one
    behind the other, temperatures in °C where known.

    The depth is that of the first modality of which the scene has photos: of RGB if it has any.
    It is infinite where the sky is seen.

    Raises:
        RunError: no pixel is opaque enough to have a depth.
    """
    ball, surface = scene.reach, scene.modalities[0]
    maps = [_depth_map(baked, camera, surface, ball) for camera in _cameras(scene)]
    if not any(np.isfinite(item.depth).any() for item in maps):
        raise RunError(
            "no view of the model is opaque enough to show a surface: train the model longer"
        )
    return maps


def carry_over(
    maps: Sequence[DepthMap],
    points: Float32[np.ndarray, "n 3"],
    tolerance: float,
    relative_tolerance: float = 0.0,
) -> tuple[Float32[np.ndarray, "n c"], Bool[np.ndarray, " n"]]:
    """Image values of each point [N, C], averaged over the cameras that see it with weights
    1 / z², and whether any camera does [N].

    Args:
        maps: of the cameras.
        points: world coordinates.
        tolerance: a point this far before or behind the depth of its pixel is still seen there,
            scene units.
        relative_tolerance: tolerance as a share of the point's depth; the larger of the two
            tolerances applies.
    """
    total = np.zeros((len(points), maps[0].image.shape[2]), dtype=np.float32)
    weight = np.zeros(len(points), dtype=np.float32)
    for item in maps:
        rows, pixels, z = visible(item.camera, points)
        seen = np.abs(item.depth[pixels] - z) < np.maximum(
            tolerance, relative_tolerance * z
        )  # false for NaN
        rows, pixels, near = rows[seen], (pixels[0][seen], pixels[1][seen]), 1 / z[seen] ** 2
        total[rows] += near[:, None] * item.image[pixels]
        weight[rows] += near
    return total / np.where(weight > 0, weight, 1)[:, None], weight > 0


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


def _cameras(scene: Scene) -> list[Camera]:
    """Of the training views' first images, at most ``MAX_VIEWS``, at most ``MAX_WIDTH_PX`` wide."""
    cameras = [scene.train[index].camera for index in evenly_spaced(len(scene.train), MAX_VIEWS)]
    return [
        camera if camera.width <= MAX_WIDTH_PX else camera.with_width(MAX_WIDTH_PX)
        for camera in cameras
    ]


def _depth_map(baked: BakedModel, camera: Camera, surface: Modality, ball: Reach) -> DepthMap:
    """The mean depth of what a pixel of one modality shows, and the values of all."""
    rendering = baked.render(camera)
    depth = rendering[surface].surface_depth(MIN_ALPHA, MAX_STEP)
    images = [
        to_float32(in_unit(modality, blend.image, baked.temperature))
        for modality, blend in rendering.items()
    ]
    distant = to_float32(ball.without_background(camera, depth))
    return DepthMap(camera, distant, np.concatenate(images, axis=2))
