"""Total variation: the pairs of neighbouring pixels that count."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.kernels.require import require


class Pairs(NamedTuple):
    """Pairs of pixels next to each other along one axis.

    Attributes:
        counted: how many count; a tensor where a mask decides.
        weights: of each, 0 for those that do not count, [H − 1, W] between rows or [H, W − 1]
            between columns; None if all count alike.
    """

    counted: int | Int64[Tensor, ""]
    weights: Float[Tensor, "h2 w2"] | None


def valid_pairs(
    image: Float[Tensor, "h w c"],
    axis: int,
    valid: Bool[Tensor, "h w"] | None,
    weights: Float[Tensor, "h2 w2"] | None,
) -> Pairs:
    """The pairs along an axis (0: between rows, 1: between columns) whose pixels are both valid.

    Args:
        image: that has them.
        axis: 0 or 1.
        valid: pixels that count, all if None.
        weights: of all pairs along the axis, all 1 if None.

    Raises:
        ValueError: tensors of other sizes or types.
    """
    height, width, _ = image.shape
    shape = (height - 1, width) if axis == 0 else (height, width - 1)
    if weights is not None:
        require("weights", weights, shape, (image.dtype,), image.device)
    if valid is None:
        return Pairs(shape[0] * shape[1], weights)
    require("valid", valid, image.shape[:2], (torch.bool,), image.device)
    both = valid.narrow(axis, 0, shape[axis]) & valid.narrow(axis, 1, shape[axis])
    counts = both.to(image.dtype)
    return Pairs(both.sum(), counts if weights is None else counts * weights)
