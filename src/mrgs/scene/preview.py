"""Intensities as bytes, and pictures for notebooks."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from mrgs.scene.camera import Camera


def preview_png(images: Sequence[Float[Tensor, "_ _ _"]]) -> bytes:
    """Images side by side as a PNG, as ``to_rgb8`` shows them: a thermal image is "white hot". At
    least one image; all are scaled to the height of the first."""
    height = images[0].shape[0]
    tiles = []
    for image in images:
        tile = Image.fromarray(to_rgb8(image))
        tiles.append(tile.resize((max(1, round(tile.width * height / tile.height)), height)))
    sheet = Image.new("RGB", (sum(tile.width for tile in tiles), height))
    left = 0
    for tile in tiles:
        sheet.paste(tile, (left, 0))
        left += tile.width
    file = io.BytesIO()
    sheet.save(file, "PNG")
    return file.getvalue()


def to_rgb8(image: Float[Tensor, "h w c"]) -> UInt8[np.ndarray, "h w 3"]:
    """Intensities in [0, 1], clamped, as bytes, NaN black; three channels are colours, of others
    the mean is shown as grey."""
    values = np.nan_to_num(image.detach().float().cpu().numpy()).clip(0, 1)
    if values.shape[2] != 3:
        values = np.repeat(values.mean(axis=2, keepdims=True), 3, axis=2)
    return np.rint(values * 255).astype(np.uint8)


NEARLY_AS_MUCH = 0.02
"""Views that show less of the points by at most this share are as good as the best one."""

MOST_POINTS = 5000


def best_view(cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> int:
    """Index of the camera that has most of a scene in its image; of several that have as much, the
    one that has the middle of the scene nearest to its axis. ``points`` are those of the scene's
    surfaces, world coordinates, at least one."""
    points = points[:: max(1, len(points) // MOST_POINTS)].double()
    middle = points.median(dim=0).values
    shares, turns = [], []
    for camera in cameras:
        pixels, _ = camera.project(points)
        shares.append(camera.contains(pixels).double().mean())
        towards = torch.nn.functional.normalize(middle - camera.position, dim=0)
        turns.append(towards @ camera.forward)
    share, turn = torch.stack(shares), torch.stack(turns)
    return int(torch.where(share >= share.max() - NEARLY_AS_MUCH, turn, -2.0).argmax())
