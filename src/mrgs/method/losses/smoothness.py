"""The smoothness loss (Sec. Total Loss)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.method.losses.photometric import LossConfig
from mrgs.system.operation import operation


def smoothness_loss(
    image: Float[Tensor, "h w c"],
    depth: Float[Tensor, "h w"],
    valid: Bool[Tensor, "h w"] | None,
    extent: float,
    image_weight: float,
    config: LossConfig,
) -> Float[Tensor, ""]:
    """L_smooth of one modality; the sum over both is Eq. 19 (smooth_total).

    Eq. 18 (smooth_sepa), Sec. Total Loss: |∇I| + |∇D|, here as a mean over the pixels, the depth in
    units of the scene's extent.

    Args:
        image: rendered colours or normalised temperatures.
        depth: rendered depth in scene units.
        valid: pixels that count, all if None.
        extent: the scene's extent in scene units.
        image_weight: of the image's part.
        config: has the weight of the depth's part.
    """
    loss = image.new_zeros(())
    if image_weight > 0:
        loss = loss + image_weight * total_variation(image, valid)
    if config.smooth_depth > 0:
        loss = loss + config.smooth_depth / extent * total_variation(depth[:, :, None], valid)
    return loss


@operation
def total_variation(
    image: Float[Tensor, "h w c"], valid: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, ""]:
    """Mean absolute first difference between rows, plus the same between columns.

    Each mean is 0 where no two pixels next to each other are valid.

    Args:
        image: colours, temperatures, or depths.
        valid: pixels that count, all if None.
    """
    total = image.new_zeros(())
    for axis in (0, 1):
        difference = image.diff(dim=axis).abs()
        counted = torch.ones_like(difference[:, :, :1], dtype=torch.bool)
        if valid is not None:
            steps = valid.shape[axis] - 1
            both = valid.narrow(axis, 0, steps) & valid.narrow(axis, 1, steps)
            counted = both[:, :, None]
        number = (counted.sum() * image.shape[2]).clamp_min(1)
        total = total + torch.where(counted, difference, 0).sum() / number
    return total
