"""Fewer Gaussians that look alike from afar: all in a cell of a grid become one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.scene.gaussians import Gaussians
from mrgs.scene.rotations import matrix_from_quaternion, quaternion_from_matrix

SMALLEST_OPACITY, MOST_OPACITY = 1e-6, 0.99
"""Their logits are finite."""

SMALLEST_SCALE = 1e-9
"""Smallest scale, scene units; keeps the logarithm finite for cells with Gaussians in a plane."""

_ENOUGH = 0.8
"""A grid is fine enough if it gives this share of the Gaussians that are asked for."""

_MOST_GRIDS = 10

_KEY = (0x1E3779B97F4A7C15, 0x3F58476D1CE4E5B9, 0x14D049BB133111EB)
"""Odd numbers that make one key of a cell's three coordinates, modulo 2**64."""


class Merged(NamedTuple):
    """Gaussians that stand for more of them: ``of`` says which of them each of the N became a part
    of, ``weights`` with what share of it."""

    gaussians: Gaussians
    of: Int64[Tensor, " n"]
    weights: Float[Tensor, " n"]

    def averaged(self, values: Float[Tensor, "n *c"]) -> Float[Tensor, "m *c"]:
        """A value of each Gaussian, averaged over the ones that it replaces."""
        return _weighted_sums(values, self.weights, self.of, len(self.gaussians))


@torch.no_grad()
def merged(gaussians: Gaussians, most: int) -> Merged:
    """At most ``most`` (above 0) Gaussians, with the moments of the ones that they replace; the
    same ones if there are no more. Mean and covariance are those of the mixture, weighted by the
    largest opacity times the area of the two largest axes. Opacity times area stays the same for
    each modality, as far as it can. All else is averaged."""
    if len(gaussians) <= most:
        ones = torch.ones(len(gaussians))
        return Merged(gaussians, torch.arange(len(gaussians)), ones)
    scales = gaussians.scales
    area = _area(scales)
    opacities = {each: gaussians.opacity(each) for each in gaussians.opacity_logits}
    covers = torch.stack(list(opacities.values())).amax(dim=0) * area
    of, count = _cells(gaussians.means, most)
    total = torch.zeros(count).index_add_(0, of, covers)
    weights = covers / total[of]

    # Moments of the mixture, about its mean.
    means = _weighted_sums(gaussians.means, weights, of, count)
    away = gaussians.means - means[of]
    rotations = torch.from_numpy(matrix_from_quaternion(gaussians.quats.numpy())).to(
        gaussians.quats
    )
    own = (rotations * scales[:, None, :].square()) @ rotations.transpose(1, 2)
    spread = own + away[:, :, None] * away[:, None, :]
    covariances = _weighted_sums(spread, weights, of, count)
    variances, axes = torch.linalg.eigh(covariances.double())
    axes[:, :, 0] *= torch.linalg.det(axes).sign()[:, None]  # a rotation, not a reflection
    new_scales = variances.clamp_min(SMALLEST_SCALE**2).sqrt().float()
    quats = torch.from_numpy(quaternion_from_matrix(axes.numpy()).astype(np.float32))

    tensors = {
        name: _weighted_sums(tensor.detach(), weights, of, count)
        for name, tensor in gaussians.tensors().items()
        if name not in ("means", "quats", "log_scales") and not name.startswith("opacity_logit")
    }
    new_area = _area(new_scales)
    for modality, opacity in opacities.items():
        covered = torch.zeros(count).index_add_(0, of, opacity * area) / new_area
        opacity = covered.clamp(SMALLEST_OPACITY, MOST_OPACITY)
        tensors[f"opacity_logit.{modality}"] = opacity.logit()[:, None]
    tensors |= {"means": means, "quats": quats, "log_scales": new_scales.log()}
    return Merged(gaussians.with_tensors(tensors), of, weights)


def _cells(means: Float[Tensor, "n 3"], most: int) -> tuple[Int64[Tensor, " n"], int]:
    """The cell of each centre in the finest cubic grid with at most ``most`` occupied cells, or
    nearly so; numbered from 0, and their number."""
    ordered, out = means.sort(dim=0).values, len(means) // 40  # without the farthest twentieth
    edge = (ordered[-1 - out] - ordered[out]).amax().item() / most ** (1 / 2)
    best: tuple[Tensor, int] | None = None
    for _ in range(_MOST_GRIDS):
        of, count = _occupied(means, edge)
        if count <= most and (best is None or count > best[1]):
            best = of, count
        if _ENOUGH * most <= count <= most:
            break
        # The cells that a surface occupies grow in number with 1 / edge².
        edge *= (count / (0.9 * most)) ** 0.5
    while best is None:
        edge *= 2
        of, count = _occupied(means, edge)
        best = (of, count) if count <= most else None
    return best


def _occupied(means: Float[Tensor, "n 3"], edge: float) -> tuple[Int64[Tensor, " n"], int]:
    cells = (means.double() / edge).floor().long()
    kinds, of = (cells * torch.tensor(_KEY)).sum(dim=1).unique(return_inverse=True)
    return of, len(kinds)


def _weighted_sums(
    values: Float[Tensor, "n *c"], weights: Float[Tensor, " n"], of: Int64[Tensor, " n"], count: int
) -> Float[Tensor, "m *c"]:
    shape = [-1] + [1] * (values.dim() - 1)
    sums = values.new_zeros(count, *values.shape[1:])
    return sums.index_add_(0, of, values * weights.reshape(shape))


def _area(scales: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Product of the two largest standard deviations."""
    return scales.prod(dim=1) / scales.amin(dim=1)
