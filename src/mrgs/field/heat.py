"""Heat between neighbouring Gaussians: the k-nearest-neighbour search and the Fourier heat transformation."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree
from torch import Tensor, nn


def nearest_neighbours(means: Float[Tensor, "n 3"], k: int) -> Int64[Tensor, "n {k}"]:
    """Indices of the k nearest other Gaussians, nearest first.

    Where fewer than k others exist, the remaining places hold the Gaussian itself: it exchanges no heat with itself.

    Raises:
        ValueError: a position is not finite.
    """
    points = means.detach().to("cpu", torch.float64).numpy()
    count = len(points)
    itself = np.arange(count, dtype=np.int64)[:, None]
    found = max(min(k, count - 1), 0)
    padding = np.broadcast_to(itself, (count, k - found))
    if found == 0:
        return torch.tensor(padding, device=means.device)
    _, index = cKDTree(points).query(points, k=found + 1, workers=-1)
    is_other = index != itself
    # Among coincident points the search may miss the Gaussian itself: then the farthest one goes instead.
    is_other[is_other.all(axis=1), -1] = False
    others = index[is_other].reshape(count, found).astype(np.int64)
    return torch.from_numpy(np.concatenate([others, padding], axis=1)).to(means.device)


class FourierHeatTransformation(nn.Module):
    """Refines each thermal feature by the heat flux from its neighbours, Sec. Fourier Heat Transformation.

    Eq. 10 (Fourier's law), q = −k ∇t, becomes in feature space

        Eq. 11 (our_fourier)            q_i  = f_q(−o_t,i · f_grad(∇F_i)),   ∇F_i = (F_u − F_i) for u in U, as [C, K]
        Eq. 12 (final_thermal_feature)  F'_i = w_a (F_i + q_i) + w_s · mean_{u in U} F_u

    f_grad is a convolution with a kernel of size K along the neighbours, which stand in the order of their distance;
    f_q is a convolution of size 1. Without neighbours (K = 0) there is no flux and F' = F.

    Args:
        width: C, the width of the features.
        k: K = |U|, the number of neighbours.
        anchor_weight: w_a.
        surrounding_weight: w_s.
    """

    def __init__(self, width: int, k: int, anchor_weight: float, surrounding_weight: float) -> None:
        super().__init__()
        self.k = k
        self.anchor_weight = anchor_weight
        self.surrounding_weight = surrounding_weight
        if k > 0:
            self.f_grad = nn.Conv1d(width, width, kernel_size=k)
            self.f_q = nn.Conv1d(width, width, kernel_size=1)

    def forward(
        self, features: Float[Tensor, "m c"], opacity: Float[Tensor, " n"], neighbours: Int64[Tensor, "n k"]
    ) -> Float[Tensor, "n c"]:
        """F' as the equations have it.

        Args:
            features: F_t, [M, C]; the first N rows are the anchors, further rows are read only as neighbours.
            opacity: o_t of the anchors, in (0, 1), [N].
            neighbours: rows of ``features``, [N, K]; gradients flow to them too.
        """
        anchors = features[: len(neighbours)]
        if self.k == 0:
            return anchors
        surroundings = features.index_select(0, neighbours.flatten()).unflatten(0, neighbours.shape).transpose(1, 2)
        gradient = self.f_grad(surroundings - anchors[:, :, None])
        flux = self.f_q(-opacity[:, None, None] * gradient).squeeze(2)
        return self.anchor_weight * (anchors + flux) + self.surrounding_weight * surroundings.mean(dim=2)

    def readout(
        self,
        features: Float[Tensor, "m c"],
        opacity: Float[Tensor, " n"],
        neighbours: Int64[Tensor, "n k"],
        output: nn.Linear,
    ) -> Float[Tensor, "n 1"]:
        """``output(self.forward(...))`` for an output layer of one channel, twenty times as fast.

        Everything behind F_t is linear in it but for the factor o_t. So the output row w is carried through the
        layers instead of the features: with v = f_qᵀ w and a_k = f_grad,kᵀ v,

            w · q_i = w · b_q − o_t,i · (Σ_k a_k · (F_{u_k} − F_i) + v · b_grad)

        and a Gaussian passes K + 1 numbers to its neighbours (a_k · F and w · F) where Eq. 11 passes K vectors.
        """
        if self.k == 0:
            return nn.functional.linear(features[: len(neighbours)], output.weight, output.bias)
        w = output.weight[0]
        v = self.f_q.weight[:, :, 0].T @ w
        taps = torch.einsum("o,ock->ck", v, self.f_grad.weight)
        projected = features @ torch.cat([taps, w[:, None]], dim=1)
        slope, level = projected[:, :-1], projected[:, -1]
        count = len(neighbours)

        gradient = (slope.gather(0, neighbours) - slope[:count]).sum(dim=1) + v @ _bias(self.f_grad)
        flux = w @ _bias(self.f_q) - opacity * gradient
        # index_select and not level[neighbours]: the backward of the latter adds in an order that changes.
        surrounding = level.index_select(0, neighbours.flatten()).unflatten(0, neighbours.shape).mean(dim=1)
        refined = self.anchor_weight * (level[:count] + flux) + self.surrounding_weight * surrounding
        return refined[:, None] + output.bias


def _bias(layer: nn.Conv1d) -> Tensor:
    assert layer.bias is not None
    return layer.bias
