"""A gain and an offset per thermal photo, for cameras with automatic gain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor, nn

from mrgs.scene.capture import Viewpoint

NEAREST = 3
"""Photos from which the gain of another one is predicted."""

SAME_PLACE = 1e-6
"""Viewpoints closer than this are the same."""


class PhotoEffect(nn.Module):
    """What a camera did to each thermal photo. Training views have a viewpoint, or None if there is
    no thermal photo; at least one has."""

    rows: Int64[Tensor, " v"]

    def __init__(self, viewpoints: Sequence[Viewpoint | None]) -> None:
        super().__init__()
        self._viewpoints = [point for point in viewpoints if point is not None]
        have_one = torch.tensor([point is not None for point in viewpoints])
        self.register_buffer("rows", have_one.cumsum(dim=0) - 1, persistent=False)

    def row_of(self, view: Int64[Tensor, "1"]) -> Int64[Tensor, "1"]:
        """The place of a training view's photo among all photos; the view must have one."""
        return self.rows.index_select(0, view)


class Gain(NamedTuple):
    """What automatic gain did to a photo: gain · image + offset, in normalised temperature."""

    gain: Float[Tensor, "1"]
    offset: Float[Tensor, "1"]

    def apply(self, image: Float[Tensor, "h w 1"]) -> Float[Tensor, "h w 1"]:
        """The image as the camera recorded it."""
        return self.gain * image + self.offset


class PhotoGain(PhotoEffect):
    """A learned gain and offset per photo; both log gains and offsets average to 0 over photos."""

    def __init__(self, viewpoints: Sequence[Viewpoint | None]) -> None:
        super().__init__(viewpoints)
        self.log_gains = nn.Parameter(torch.zeros(len(self._viewpoints), 1))
        self.offsets = nn.Parameter(torch.zeros(len(self._viewpoints), 1))

    def of(self, view: Int64[Tensor, "1"]) -> Gain:
        """The gain of a training view's photo; the view must have one."""
        row = self.row_of(view)
        log_gain, offset = (
            each.index_select(0, row)[0] - each.mean(dim=0)
            for each in (self.log_gains, self.offsets)
        )
        return Gain(log_gain.exp(), offset)

    def expected(self, viewpoint: Viewpoint) -> Gain:
        """The gain predicted for a photo outside the training set; see ``expected_gains``."""
        gains = torch.cat([self.log_gains, self.offsets], dim=1).detach().double()
        found = expected_gains(gains - gains.mean(dim=0), self._viewpoints, viewpoint)
        log_gain, offset = found.to(self.offsets).chunk(2)
        return Gain(log_gain.exp(), offset)


def expected_gains(
    gains: Float[Tensor, "v s"], viewpoints: Sequence[Viewpoint], viewpoint: Viewpoint
) -> Float[Tensor, " s"]:
    """Mean gain of the nearest photos, as cameras that see about the same scale alike; each column
    times the factor from 0 to 1 that predicts best in leave-one-out over the known photos, near 0
    for random gains.

    Args:
        gains: log gain and offset of each photo, at least one; their mean is 0.
        viewpoint: of the photo to predict; if exactly one known photo is there, its own gain is
            returned.
    """
    distances = viewpoint_distances([viewpoint], viewpoints)
    if (same := only_one_at(distances[0])) is not None:
        return gains[same]
    if len(viewpoints) <= NEAREST:
        return torch.zeros_like(gains[0])
    predicted = _nearest_means(
        gains, viewpoint_distances(viewpoints, viewpoints).fill_diagonal_(torch.inf)
    )
    square = predicted.square().sum(dim=0)
    trust = torch.where(square > 0, (predicted * gains).sum(dim=0) / square, 0.0).clamp(0, 1)
    return trust * _nearest_means(gains, distances)[0]


def only_one_at(distances: Float[Tensor, " v"]) -> int | None:
    """The photo at a viewpoint, by the distances of all from it; None if none is, or several."""
    same = (distances < SAME_PLACE).nonzero()[:, 0]
    return int(same[0]) if len(same) == 1 else None


def _nearest_means(
    gains: Float[Tensor, "v s"], distances: Float[Tensor, "m v"]
) -> Float[Tensor, "m s"]:
    """Mean gain of the nearest photos, weighted by inverse distance."""
    near = distances.topk(NEAREST, dim=1, largest=False)
    weights = 1 / near.values.clamp_min(SAME_PLACE)
    weights = weights / weights.sum(dim=1, keepdim=True)
    return (weights[:, :, None] * gains[near.indices]).sum(dim=1)


def viewpoint_distances(
    some: Sequence[Viewpoint], others: Sequence[Viewpoint]
) -> Float[Tensor, "m n"]:
    """Distance between viewpoints: that of the positions (extents) plus the angle (radians)."""
    positions, directions = _columns(some)
    other_positions, other_directions = _columns(others)
    exact = "donot_use_mm_for_euclid_dist"  # the product form loses its digits far from the origin
    apart = torch.cdist(positions, other_positions, compute_mode=exact)
    return apart + (directions @ other_directions.T).clamp(-1, 1).arccos()


def _columns(
    viewpoints: Sequence[Viewpoint],
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    positions, directions = torch.tensor(viewpoints, dtype=torch.float64).unbind(1)
    return positions, directions
