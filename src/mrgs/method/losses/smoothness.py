"""The smoothness loss (Sec. Total Loss)."""

from __future__ import annotations

from typing import TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.method.losses.photometric import LossConfig
from mrgs.system.operation import operation

CONTRAST = 0.02
"""Difference of colours, of which 1 is the whole range, that is an edge (docs/decisions, 049)."""

Similarity: TypeAlias = tuple[Float[Tensor, "h1 w"] | None, Float[Tensor, "h w1"] | None]
"""Similarity of neighbouring rows' pixels, [H − 1, W], and columns', [H, W − 1]; None for 1."""


def smoothness_loss(
    image: Float[Tensor, "h w c"],
    depth: Float[Tensor, "h w"],
    valid: Bool[Tensor, "h w"] | None,
    extent: float,
    image_weight: float,
    config: LossConfig,
    similarity: Similarity = (None, None),
) -> Float[Tensor, ""]:
    """L_smooth of one modality; the sum over both is Eq. 19 (smooth_total).

    Eq. 18 (smooth_sepa), Sec. Total Loss: |∇I| + |∇D|, here as a mean over the pixels, the depth in
    units of the scene's extent.

    Args:
        image: rendered colours or normalised temperatures.
        depth: rendered depth in scene units, as the scene's extent.
        valid: pixels that count, all if None.
        image_weight: of the image's part; the configuration has that of the depth's part.
        similarity: of neighbouring pixels, which weighs the differences of the image.
    """
    loss = image.new_zeros(())
    if image_weight > 0:
        loss = loss + image_weight * total_variation(image, valid, *similarity)
    if config.smooth_depth > 0:
        loss = loss + config.smooth_depth / extent * total_variation(depth[:, :, None], valid)
    return loss


@torch.no_grad()
def similarity_of(guide: Float[Tensor, "h w c"], least: float = 0.0) -> Similarity:
    """How alike neighbouring pixels are in another image of the same pixels, in [0, 1]: from 1 for
    the same colour down to ``least``, by exp(−d / 0.02) with d the mean over the channels of their
    absolute difference. Not in the paper."""
    rows, columns = (
        guide.diff(dim=axis).abs().mean(dim=2).div(-CONTRAST).exp().mul(1 - least).add(least)
        for axis in (0, 1)
    )
    return rows, columns


@operation
def total_variation(
    image: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None = None,
    row_weights: Float[Tensor, "h1 w"] | None = None,
    column_weights: Float[Tensor, "h w1"] | None = None,
) -> Float[Tensor, ""]:
    """Mean absolute first difference between rows, plus the same between columns.

    Each mean is over the pairs of valid pixels (all are, if ``valid`` is None), 0 where there is
    none. The weights of the differences, 1 if None, multiply them and do not change their number.
    """
    total = image.new_zeros(())
    for axis, weights in enumerate((row_weights, column_weights)):
        difference = image.diff(dim=axis).abs()
        if weights is not None:
            difference = weights[:, :, None] * difference
        counted = torch.ones_like(difference[:, :, :1], dtype=torch.bool)
        if valid is not None:
            steps = valid.shape[axis] - 1
            both = valid.narrow(axis, 0, steps) & valid.narrow(axis, 1, steps)
            counted = both[:, :, None]
        number = (counted.sum() * image.shape[2]).clamp_min(1)
        total = total + torch.where(counted, difference, 0).sum() / number
    return total
