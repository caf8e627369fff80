"""Heat between neighbouring Gaussians: nearest neighbours, and the Fourier heat transformation."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from mrgs.system.operation import operation

SEARCHED_TOGETHER = 1_024
"""Gaussians whose distances to all others are in memory at once."""


def neighbour_distances(
    neighbours: Int64[Tensor, "n k"], means: Float[Tensor, "n 3"], k: int
) -> Float[Tensor, "n {k}"]:
    """Distance of each Gaussian to its neighbours. Unlike the indices it is the same for every
    search, because points at the same distance may stand in any order."""
    points = means.detach().double()
    return (points[neighbours] - points[:, None]).norm(dim=2)


@operation(measure=neighbour_distances)
def nearest_neighbours(means: Float[Tensor, "n 3"], k: int) -> Int64[Tensor, "n {k}"]:
    """Indices of the k nearest other Gaussians, nearest first; if there are fewer, filled up with
    the Gaussian itself, which exchanges no heat with itself. ValueError if a position is not
    finite; on a GPU it counts as very far away, as the host would have to wait for the device."""
    points = means.detach().double()
    if not points.isfinite().all():
        raise ValueError("the positions of Gaussians must be finite")
    itself = torch.arange(len(points), device=points.device)
    found = max(min(k, len(points) - 1), 0)
    neighbours = itself[:, None].repeat(1, k)
    for rows in itself.split(SEARCHED_TOGETHER):
        distances = torch.cdist(
            points[rows], points, compute_mode="donot_use_mm_for_euclid_dist"
        ).index_put((rows - rows[0], rows), points.new_tensor(torch.inf))
        neighbours[rows, :found] = distances.topk(found, largest=False).indices
    return neighbours


class FourierHeatTransformation(nn.Module):
    """Refines each thermal feature by the heat flux from its neighbours, Sec. Fourier Heat
    Transformation.

    Eq. 10 (Fourier's law), q = −k ∇t, becomes in feature space

        Eq. 11 (our_fourier)            q_i  = f_q(−o_t,i · f_grad(∇F_i))
                                        with ∇F_i = (F_u − F_i) for u in U, as [C, K]
        Eq. 12 (final_thermal_feature)  F'_i = w_a (F_i + q_i) + w_s · mean_{u in U} F_u

    f_grad is a convolution with a kernel of size K = |U| along the neighbours, in the order of
    their distance; f_q is a convolution of size 1. Without neighbours there is no flux and F' = F.
    Both have biases, as convolutions have by default, so a uniform field keeps a flux; with
    ``bias=False`` it would have none, as Fourier's law wants.
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
        """F' as the equations have it. The first N rows of the ``features`` F_t are the anchors, of
        which ``opacity`` is o_t; further rows are read only as ``neighbours``, to which gradients
        flow too."""
        anchors = features[: len(neighbours)]
        if self.k == 0:
            return anchors
        gathered = features.index_select(0, neighbours.flatten())
        surroundings = gathered.unflatten(0, neighbours.shape).transpose(1, 2)
        gradient = self.f_grad(surroundings - anchors[:, :, None])
        flux = self.f_q(-opacity[:, None, None] * gradient).squeeze(2)
        mean = surroundings.mean(dim=2)
        return self.anchor_weight * (anchors + flux) + self.surrounding_weight * mean
