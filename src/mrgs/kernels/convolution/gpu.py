"""The 3 × 3 convolution of one plane on a GPU."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn


def convolve(
    plane: Float[Tensor, "h w"], weights: Float[Tensor, "3 3"], bias: Float[Tensor, "1"]
) -> Float[Tensor, "h w"]:
    """``mrgs.method.losses.radiation.convolve`` as a product, which does not depend on torch's
    leave to convolve with ten bits of mantissa."""
    neighbourhoods = nn.functional.unfold(plane[None, None], kernel_size=3, padding=1)[0]
    return (weights.reshape(1, 9) @ neighbourhoods).view(plane.shape) + bias
