"""The losses that compare images, for float32 on a GPU: nothing here makes the host wait."""

from __future__ import annotations

from functools import partial

from jaxtyping import Float
from torch import Tensor

from mrgs.kernels.ssim import compare_gpu, losses
from mrgs.kernels.ssim.losses import Dissimilarity


def compare(
    x: Float[Tensor, "h w c"],
    y: Float[Tensor, "h w c"],
    weights: Float[Tensor, "h2 w"],
    scalars: tuple[float, float, float, float, float, float],
    wants_errors: bool,
) -> Dissimilarity:
    """``losses.Compare``."""
    found = compare_gpu.compare(x, y, weights, scalars, y.requires_grad, wants_errors)
    grad_x = found.gradient_x if x.requires_grad else None
    return Dissimilarity(found.total, grad_x, found.gradient_y, found.errors)


photometric_loss = partial(losses.photometric_loss, compare)
boltzmann_loss = partial(losses.boltzmann_loss, compare)
