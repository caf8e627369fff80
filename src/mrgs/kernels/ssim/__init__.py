"""Losses that compare images, around a fused kernel that gives L1 and SSIM with their gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.kernels.known_gradient import with_gradients
from mrgs.method.losses.ssim import K1, K2, STRUCTURE_C2

STRUCTURE_C1 = 1e20
"""Next to this C1 the means do not count: what is left of SSIM is its structure, S-SSIM."""

STRUCTURE = (1.0, 0.0, STRUCTURE_C1, STRUCTURE_C2, 1.0, 0.0)
"""The ``Scalars`` of S-SSIM: SSIM's structure term alone, without L1."""

LEAST_WIDTH = 1e-30
"""A Huber loss of this width has the gradient of |x − y|, also in float32."""


class Dissimilarity(NamedTuple):
    """Two images compared.

    Attributes:
        total: the weighted sum over all values; on a GPU a tensor that stays there, so that the
            host need not wait.
        grad_x: its gradient by x, [H, W, C]; None unless x asks for one.
        grad_y: its gradient by y, [H, W, C]; None unless y asks for one.
        errors: 1 − SSIM of each value, if wanted.
    """

    total: float | Float[Tensor, ""]
    grad_x: Float[Tensor, "h w c"] | None
    grad_y: Float[Tensor, "h w c"] | None
    errors: Float[Tensor, "h w c"] | None = None


Scalars: TypeAlias = tuple[float, float, float, float, float, float]

Compare: TypeAlias = Callable[[Tensor, Tensor, Tensor, Scalars, bool], Dissimilarity]
"""A device's kernel: Σ weights (l1 g (d − h g) + dssim (1 − SSIM)), with d = x − y and g = s d
between −1 and 1. That is |d| where s is large and h = 0, and the Huber loss of width δ where s = 1
/ δ and h = δ / 2.

It takes x and y, [H, W, C]; the weights of each pixel, [H, W], or [1, W] for all rows alike, and
where they are 0, both images are read as 0; the scalars dssim and l1, the shares of 1 − SSIM and of
L1, c1 and c2, SSIM's stabilisers, s and h; and whether 1 − SSIM of each value is wanted."""


def l1_dssim(
    compare: Compare, x: Tensor, y: Tensor, weights: Tensor, dssim: float, huber_width: float = 0.0
) -> Dissimilarity:
    """Σ weights ((1 − dssim) H(x − y) + dssim (1 − SSIM)) with ``ssim.ssim_map`` at a data range of
    1 and H the Huber loss, |x − y| where its width is 0; see ``Compare``."""
    steepness, half_width = 1 / max(huber_width, LEAST_WIDTH), huber_width / 2
    scalars = (dssim, 1 - dssim, K1**2, K2**2, steepness, half_width)
    return compare(x, y, weights, scalars, False)


def photometric_loss(
    compare: Compare,
    render: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None,
    dssim: float,
    huber_width: float = 0.0,
) -> Float[Tensor, ""]:
    """``mrgs.method.losses.photometric.photometric_loss`` by a fused kernel."""
    weights = _mean_weights(render[:, :, 0], valid) / render.shape[2]
    compared = l1_dssim(compare, render, target, weights, dssim, huber_width)
    return with_gradients(compared.total, (render, target), (compared.grad_x, compared.grad_y))


def boltzmann_loss(
    compare: Compare,
    thermal: Float[Tensor, "h w"],
    radiation: Float[Tensor, "h w"],
    uncertainty: Float[Tensor, "h w"],
    valid: Bool[Tensor, "h w"] | None = None,
) -> Float[Tensor, ""]:
    """``mrgs.method.losses.radiation.boltzmann_loss`` by a fused kernel."""
    mean, u = _mean_weights(thermal, valid), uncertainty.detach()
    trust = mean / u.exp()
    compared = compare(thermal[:, :, None], radiation[:, :, None], trust, STRUCTURE, True)
    assert compared.errors is not None
    untrusted = (mean * u).sum(dtype=torch.float64)
    value = compared.total + (untrusted if isinstance(compared.total, Tensor) else untrusted.item())
    gradients = [
        None if gradient is None else gradient[:, :, 0]
        for gradient in (compared.grad_x, compared.grad_y)
    ]
    by_uncertainty = mean - trust * compared.errors[:, :, 0]
    return with_gradients(value, (thermal, radiation, uncertainty), (*gradients, by_uncertainty))


def _mean_weights(
    plane: Float[Tensor, "h w"], valid: Bool[Tensor, "h w"] | None
) -> Float[Tensor, "h2 w"]:
    """Each pixel's weight in the mean over the valid ones: [H, W], or [1, W] where equal."""
    if valid is None:
        return plane.new_full((1, plane.shape[1]), 1 / plane.numel())
    return valid.to(plane.dtype) / valid.sum().clamp_min(1)
