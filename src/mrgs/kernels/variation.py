"""Total variation of an image with its gradient, in a few operations of torch on any device. The
derivative of a |difference| is its sign times a, negative for the pixel before, positive behind: a
pixel's gradient is the two steps that lead to it less the two that leave it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.kernels.known_gradient import with_gradients
from mrgs.kernels.require import require


def total_variation(
    image: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None = None,
    row_weights: Float[Tensor, "h1 w"] | None = None,
    column_weights: Float[Tensor, "h w1"] | None = None,
) -> Float[Tensor, ""]:
    """``mrgs.method.losses.smoothness.total_variation`` for float32 or float64; a GPU's host does
    not wait. ValueError for tensors of other sizes, types or devices."""
    require("image", image, (None, None, None), (torch.float32, torch.float64), image.device)
    pixels = image.detach()
    total, gradient = pixels.new_zeros((), dtype=torch.float64), torch.zeros_like(pixels)
    for axis, weights in ((1, column_weights), (0, row_weights)):
        differences, size = pixels.diff(dim=axis), pixels.shape[axis] - 1
        steps = differences.sign().mul_(_factors(image, axis, valid, weights))
        gradient.narrow(axis, 1, size).add_(steps)
        gradient.narrow(axis, 0, size).sub_(steps)
        # Row by row, so that the order of the sum does not depend on the number of threads.
        total += differences.mul_(steps).sum(dim=(1, 2), dtype=torch.float64).sum()
    return with_gradients(total, [image], [gradient])


def _factors(
    image: Float[Tensor, "h w c"],
    axis: int,
    valid: Bool[Tensor, "h w"] | None,
    weights: Float[Tensor, "h2 w2"] | None,
) -> float | Float[Tensor, "h2 w2 1"]:
    """The weight of each difference between rows (axis 0) or columns (1) over the number of all,
    0 where one of its two pixels does not count."""
    height, width, channels = image.shape
    shape = (height - 1, width) if axis == 0 else (height, width - 1)
    if weights is not None:
        require("weights", weights, shape, (image.dtype,), image.device)
    if valid is None:
        scale = 1 / max(channels * shape[0] * shape[1], 1)
        return scale if weights is None else scale * weights[:, :, None]
    require("valid", valid, (height, width), (torch.bool,), image.device)
    both = valid.narrow(axis, 0, shape[axis]) & valid.narrow(axis, 1, shape[axis])
    number = (channels * both.sum()).clamp_min(1).double()
    factors = (1 / number).to(image.dtype) * (both if weights is None else both * weights)
    return factors[:, :, None]
