"""Intensities as bytes, and pictures for notebooks."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor


def preview_png(images: Sequence[Float[Tensor, "_ _ _"]]) -> bytes:
    """Images side by side as a PNG, as ``to_rgb8`` shows them: a thermal image is "white hot".

    Args:
        images: at least one; all are scaled to the height of the first.
    """
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
    """Intensities in [0, 1], clamped, as bytes; NaN turns black.

    Three channels are colours; of any other number, the mean is shown as grey.
    """
    values = np.nan_to_num(image.detach().float().cpu().numpy()).clip(0, 1)
    if values.shape[2] != 3:
        values = np.repeat(values.mean(axis=2, keepdims=True), 3, axis=2)
    return np.rint(values * 255).astype(np.uint8)
