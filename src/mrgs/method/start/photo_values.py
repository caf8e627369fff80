"""What the photos have where points of the scene are: their colours or temperatures before any
training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.spatial import cKDTree
from torch import Tensor

from mrgs.scene import Camera, PosedImage, evenly_spaced
from mrgs.scene.point_cloud import coincident_points, spare_points

PHOTOS = 64
"""Largest number of photos that are read, evenly spread."""

LOOKED_AT_PX = 600
"""A large photo may be read at a fraction of its size that is at least so wide."""

CELLS_ACROSS = 48
"""Number of cells across a photo, which are about square. A point is hidden where
another in its cell, or in one of those around it, is much nearer."""

MUCH_NEARER = 1.5
"""Ratio of distances above which a farther point is hidden."""

NEIGHBOURS = 8
"""Number of others whose values a point takes that no photo shows."""

SMALLEST_DISTANCE = 1e-9
"""That divides; scene units."""


class _Shown(NamedTuple):
    """What a photo has where the points are; NaN for a point that it does not show.

    Attributes:
        in_frame: of all points in the frame.
        unhidden: of those that nothing stands before.
    """

    in_frame: Float[Tensor, "n c"]
    unhidden: Float[Tensor, "n c"]


def photo_values(
    positions: Float[Tensor, "n 3"], photos: Sequence[PosedImage], channels: int
) -> Float[Tensor, "n {channels}"]:
    """The median over the photos that show a point of the value they have there, channel by
    channel.

    A point that is hidden in every photo takes the median over all that have it in their frame; one
    that no photo has there is NaN.

    Args:
        positions: points in world coordinates, which also hide each other.
        photos: of one modality.
        channels: 3 for RGB, 1 for normalised temperatures.
    """
    if not photos:
        return positions.new_full((len(positions), channels), torch.nan)
    chosen = [photos[index] for index in evenly_spaced(len(photos), PHOTOS)]
    shown = [_shown(positions.double(), photo) for photo in chosen]
    in_frame, unhidden = (
        torch.stack(values).nanmedian(dim=0).values for values in zip(*shown, strict=True)
    )
    return torch.where(unhidden.isnan(), in_frame, unhidden).to(positions)


def with_neighbours_values(
    positions: Float[Tensor, "n 3"], values: Float[Tensor, "n c"]
) -> Float[Tensor, "n c"]:
    """Values in which a point that has none takes those of its nearest points that have one,
    weighted by the inverse square of their distance.

    Args:
        positions: of the points.
        values: NaN for a point that has none; where none has any, all stay so.
    """
    unknown = values.isnan().any(dim=1)
    if unknown.all():
        return values
    known, places = values[~unknown].double().numpy(), positions[~unknown].double().numpy()
    spare = spare_points(coincident_points(places, NEIGHBOURS), NEIGHBOURS)
    known, places = np.delete(known, spare, axis=0), np.delete(places, spare, axis=0)
    tree = cKDTree(places)
    nearest = range(1, min(NEIGHBOURS, len(known)) + 1)
    distance, index = tree.query(positions[unknown].double().numpy(), k=list(nearest), workers=-1)
    weight = 1 / np.square(distance.clip(SMALLEST_DISTANCE))
    mean = (weight[:, :, None] * known[index]).sum(1) / weight.sum(1, keepdims=True)
    return values.masked_scatter(unknown[:, None], torch.from_numpy(mean).to(values))


def _shown(positions: Float64[Tensor, "n 3"], photo: PosedImage) -> _Shown:
    pixels, depth = photo.camera.project(positions)
    in_frame = photo.camera.contains(pixels)
    pixels = torch.where(in_frame[:, None], pixels, 0)
    hidden = _hidden(photo.camera, pixels, torch.where(in_frame, depth, torch.inf))
    image = photo.look(LOOKED_AT_PX)
    height, width, _ = image.values.shape
    per_pixel = pixels.new_tensor([width / photo.camera.width, height / photo.camera.height])
    column, row = (pixels * per_pixel).long().T
    if image.valid is not None:
        in_frame = in_frame & image.valid[row, column]
    values = torch.where(in_frame[:, None], image.values[row, column], torch.nan)
    return _Shown(values, torch.where(hidden[:, None], torch.nan, values))


def _hidden(
    camera: Camera, pixels: Float64[Tensor, "n 2"], depth: Float64[Tensor, " n"]
) -> Bool[Tensor, " n"]:
    """Which points stand behind others, as far as these tell; those at infinity stand before
    none."""
    rows = max(1, round(CELLS_ACROSS * camera.height / camera.width))
    cells_per_px = pixels.new_tensor([CELLS_ACROSS / camera.width, rows / camera.height])
    column, row = (pixels * cells_per_px).long().T
    cell = row * CELLS_ACROSS + column
    nearest = depth.new_full((rows * CELLS_ACROSS,), torch.inf).scatter_reduce(
        0, cell, depth, "amin"
    )
    around = -torch.nn.functional.max_pool2d(
        -nearest.view(1, rows, CELLS_ACROSS), 3, stride=1, padding=1
    )
    return depth > MUCH_NEARER * around.flatten()[cell]
