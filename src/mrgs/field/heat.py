"""Heat between neighbouring Gaussians: the k-nearest-neighbour search and the Fourier heat
transformation."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree
from torch import Tensor, nn

from mrgs.field import cpu
from mrgs.field.product import product
from mrgs.system import gpu


def nearest_neighbours(means: Float[Tensor, "n 3"], k: int) -> Int64[Tensor, "n {k}"]:
    """Indices of the k nearest other Gaussians, nearest first.

    Where fewer than k others exist, the remaining places hold the Gaussian itself: it exchanges no
    heat with itself. On a GPU up to 16 neighbours are searched there, more on the host.

    Raises:
        ValueError: a position is not finite. Not on a GPU, which takes it as very far away: to look
            for it, the host would have to wait for the device.
    """
    if gpu.serves(means):
        from mrgs.field.gpu import MAX_K
        from mrgs.field.gpu import nearest_neighbours as nearest_on_device

        if k <= MAX_K:
            return nearest_on_device(means, k)
    points = means.detach().to("cpu", torch.float64).numpy()
    count = len(points)
    itself = np.arange(count, dtype=np.int64)[:, None]
    found = max(min(k, count - 1), 0)
    padding = np.broadcast_to(itself, (count, k - found))
    if found == 0:
        return torch.tensor(padding, device=means.device)
    tree = cKDTree(points, balanced_tree=False)
    index = np.empty((count, found + 1), np.int64)
    order = (
        tree.indices
    )  # neighbours in the tree are near each other in memory: a quarter of the time saved
    index[order] = tree.query(points[order], k=found + 1, workers=-1)[1]
    is_other = index != itself
    # Among coincident points the search may miss the Gaussian itself: then the farthest one goes
    # instead.
    is_other[is_other.all(axis=1), -1] = False
    others = index[is_other].reshape(count, found)
    return torch.from_numpy(np.concatenate([others, padding], axis=1)).to(means.device)


def with_neighbours(
    rows: Int64[Tensor, " v"], neighbours: Int64[Tensor, "n k"]
) -> Int64[Tensor, " m"]:
    """These Gaussians and all their neighbours, each once, in ascending order; for tensors on the
    CPU."""
    return torch.from_numpy(cpu.with_neighbours(rows.numpy(), neighbours.contiguous().numpy()))


class FourierHeatTransformation(nn.Module):
    """Refines each thermal feature by the heat flux from its neighbours, Sec. Fourier Heat
    Transformation.

    Eq. 10 (Fourier's law), q = −k ∇t, becomes in feature space

        Eq. 11 (our_fourier)            q_i  = f_q(−o_t,i · f_grad(∇F_i))
                                        with ∇F_i = (F_u − F_i) for u in U, as [C, K]
        Eq. 12 (final_thermal_feature)  F'_i = w_a (F_i + q_i) + w_s · mean_{u in U} F_u

    f_grad is a convolution with a kernel of size K along the neighbours, which stand in the order
    of their distance; f_q is a convolution of size 1. Without neighbours (K = 0) there is no flux
    and F' = F.

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
        self,
        features: Float[Tensor, "m c"],
        opacity: Float[Tensor, " n"],
        neighbours: Int64[Tensor, "n k"],
    ) -> Float[Tensor, "n c"]:
        """F' as the equations have it.

        Args:
            features: F_t, [M, C]; the first N rows are the anchors, further rows are read only as
                neighbours.
            opacity: o_t of the anchors, in (0, 1), [N].
            neighbours: rows of ``features``, [N, K]; gradients flow to them too.
        """
        anchors = features[: len(neighbours)]
        if self.k == 0:
            return anchors
        surroundings = (
            features.index_select(0, neighbours.flatten())
            .unflatten(0, neighbours.shape)
            .transpose(1, 2)
        )
        gradient = self.f_grad(surroundings - anchors[:, :, None])
        flux = self.f_q(-opacity[:, None, None] * gradient).squeeze(2)
        return self.anchor_weight * (anchors + flux) + self.surrounding_weight * surroundings.mean(
            dim=2
        )

    def readout_rows(self, output: nn.Linear) -> Float[Tensor, "r c"]:
        """What an anchor reads of its k-th neighbour's feature, a_k, and of any feature, w: see
        ``readout``.

        Args:
            output: the layer behind F', of one channel.
        """
        w = output.weight
        if self.k == 0:
            return w
        taps = product(self._through_f_q(w), self.f_grad.weight.flatten(1)).view(-1, self.k)
        return torch.cat([taps.T, w])

    def readout(
        self,
        projected: Float[Tensor, "n r"],
        opacity: Float[Tensor, " v"],
        neighbours: Int64[Tensor, "n k"],
        rows: Int64[Tensor, " v"],
        output: nn.Linear,
    ) -> Float[Tensor, "v 1"]:
        """``output(F')`` of some anchors for an output layer of one channel, far faster than
        ``forward``.

        Everything behind F_t is linear in it but for the factor o_t. So the output row w is carried
        through the layers instead of the features: with v = f_qᵀ w and a_k = f_grad,kᵀ v,

            w · q_i = w · b_q − o_t,i · (Σ_k a_k · (F_{u_k} − F_i) + v · b_grad)

        and a Gaussian passes K + 1 numbers to its neighbours (a_k · F and w · F) where Eq. 11
        passes K vectors.

        Args:
            projected: F_t · ``readout_rows``ᵀ; read at the anchors and at their neighbours.
            opacity: o_t of the anchors, in (0, 1).
            neighbours: of all N Gaussians; gradients flow to them too.
            rows: the anchors.
            output: the layer behind F'.
        """
        if self.k == 0:
            return projected.index_select(0, rows) + output.bias
        w = output.weight
        v = self._through_f_q(w)
        constants = torch.stack(
            [(w * _bias(self.f_q)).sum(), (v * _bias(self.f_grad)).sum(), output.bias[0]]
        )
        weights = (self.anchor_weight, self.surrounding_weight)
        return refine(projected, opacity, constants, neighbours, rows, weights)[:, None]

    def _through_f_q(self, w: Float[Tensor, "1 c"]) -> Float[Tensor, "1 c"]:
        """v = f_qᵀ w, as a row."""
        return product(w, self.f_q.weight[:, :, 0])


def refine(
    projected: Float[Tensor, "n r"],
    opacity: Float[Tensor, " v"],
    constants: Float[Tensor, "3"],
    neighbours: Int64[Tensor, "n k"],
    rows: Int64[Tensor, " v"],
    weights: tuple[float, float],
) -> Float[Tensor, " v"]:
    """Eq. 12 in the direction w of the output layer, w · F' + b, with the flux of Eq. 11.

    Args:
        projected: a_1 · F … a_K · F and w · F of each Gaussian F.
        opacity: o_t of the anchors.
        constants: w · b_q, v · b_grad and b.
        neighbours: u_1 … u_K of all Gaussians.
        rows: the anchors i.
        weights: w_a and w_s.
    """
    if cpu.serves(projected):
        return cpu.refine(projected, opacity, constants, neighbours, rows, weights)
    near, anchors = neighbours.index_select(0, rows), projected.index_select(0, rows)
    slope, level = projected[:, :-1], projected[:, -1]
    gradient = (slope.gather(0, near) - anchors[:, :-1]).sum(dim=1)
    flux = constants[0] - opacity * (gradient + constants[1])
    # index_select and not level[near]: on a CPU the backward of the latter adds in an order that
    # changes. On a GPU both do, because they add atomically; there the last bits of the gradients
    # differ from run to run.
    surrounding = level.index_select(0, near.flatten()).unflatten(0, near.shape).mean(dim=1)
    return weights[0] * (anchors[:, -1] + flux) + weights[1] * surrounding + constants[2]


def _bias(layer: nn.Conv1d) -> Tensor:
    assert layer.bias is not None
    return layer.bias
