"""Positional encoding, the Fourier features that the embedding starts from, rows of Gaussians."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int64, Shaped
from torch import Tensor, nn

QUANTILE = 0.97
"""Share of the start points that normalised positions keep inside [-1, 1]."""

EMBEDDING_NOISE = 1e-4
"""Standard deviation of the noise added to the embedding's start."""


def positional_encoding(
    x: Float[Tensor, "n d"], frequencies: int
) -> Float[Tensor, "n 2*{frequencies}*d"]:
    """Eq. 9 (positional_embedding), Sec. Modeling Lambertian Reflectance: PE(x) = concat[sin(2ⁿ π
    x), cos(2ⁿ π x)] for n = 0 … L − 1 of normalised positions or unit directions: for each n first
    the d sines, then the d cosines."""
    scales = math.pi * 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = x[:, None, :] * scales[:, None]
    return torch.cat([angles.sin(), angles.cos()], dim=2).flatten(1)


def position_frame(positions: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """The centre and scale that bring positions into [-1, 1]: (positions − center) / scale. The
    centre is the mean, the scale the 97 % quantile of the largest absolute coordinate about it, so
    that a few far points do not squeeze the rest; without points it is the identity."""
    if len(positions) == 0:
        return positions.new_zeros(3), positions.new_ones(())
    center = positions.mean(dim=0)
    reach = (positions - center).abs().amax(dim=1)
    rank = math.ceil(QUANTILE * len(reach))
    return center, reach.kthvalue(rank).values.clamp_min(1e-6)


def fourier_embedding(positions: Float[Tensor, "n 3"], width: int) -> Float[Tensor, "n {width}"]:
    """The start of the multi-modal embedding e_m, which the paper leaves open: WildGaussians'
    Fourier features of the normalised positions plus a little noise from torch's default generator.
    The width is a multiple of 6: sine and cosine of three coordinates per frequency."""
    features = positional_encoding(positions.detach(), width // 6)
    return features + EMBEDDING_NOISE * torch.randn_like(features)


def take(
    tensor: Shaped[Tensor, "n ..."], rows: Int64[Tensor, " v"] | None
) -> Shaped[Tensor, "v ..."]:
    """The given rows of a tensor; all of it if None."""
    return tensor if rows is None else tensor.index_select(0, rows)


def viewing_directions(
    means: Float[Tensor, "n 3"], camera_position: Float[Tensor, "3"]
) -> Float[Tensor, "n 3"]:
    """Unit vectors from the camera to the Gaussians."""
    return nn.functional.normalize(means - camera_position, dim=1)
