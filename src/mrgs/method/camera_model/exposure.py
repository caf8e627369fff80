"""A gain and an offset of each photo, for cameras that expose or scale every photo anew."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from mrgs.scene import Camera

NEAREST = 3
"""So many photos tell what is to be expected of another one."""

SAME_PLACE = 1e-6
"""Cameras less far apart are the same."""


class Look(NamedTuple):
    """Where a photo was taken from, and in which direction; world coordinates.

    Attributes:
        position: of the camera, in scene extents.
        forward: its viewing direction, of length 1.
    """

    position: tuple[float, float, float]
    forward: tuple[float, float, float]

    @classmethod
    def of(cls, camera: Camera, extent: float) -> Look:
        """That of a camera, in a scene of this extent."""
        return cls(_triple((camera.position / extent).tolist()), _triple(camera.forward.tolist()))

    @classmethod
    def from_json(cls, values: Any) -> Look:
        """From what JSON makes of it; TypeError or ValueError where it is something else."""
        position, forward = values
        return cls(_triple(position), _triple(forward))


class Setting(NamedTuple):
    """What a camera did to a photo: gain · image + offset, each [C]."""

    gain: Float[Tensor, " c"]
    offset: Float[Tensor, " c"]

    def expose(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "h w c"]:
        """The image as the camera would have written it."""
        return self.gain * image + self.offset


class Exposure(nn.Module):
    """A setting of each photo and channel; over all photos the gains average to 1 and the offsets
    to 0.

    Args:
        looks: of each training view, None where it has no such photo; at least one has.
        channels: of the photos.
    """

    def __init__(self, looks: Sequence[Look | None], channels: int) -> None:
        super().__init__()
        self._looks = [look for look in looks if look is not None]
        self._rows = list(accumulate((look is not None for look in looks), initial=0))
        self.log_gains = nn.Parameter(torch.zeros(len(self._looks), channels))
        self.offsets = nn.Parameter(torch.zeros(len(self._looks), channels))

    def of(self, view: int) -> Setting:
        """That of the photo of a training view, which must have one."""
        row = self._rows[view]
        gain = (self.log_gains[row] - self.log_gains.mean(dim=0)).exp()
        return Setting(gain, self.offsets[row] - self.offsets.mean(dim=0))

    def expected(self, look: Look) -> Setting:
        """What is to be expected of a photo that was not learned from: see
        ``expected_settings``."""
        settings = torch.cat([self.log_gains, self.offsets], dim=1).detach().double()
        settings = settings - settings.mean(dim=0)
        log_gain, offset = expected_settings(settings, self._looks, look).to(self.offsets).chunk(2)
        return Setting(log_gain.exp(), offset)


def expected_settings(
    settings: Float[Tensor, "v s"], looks: Sequence[Look], look: Look
) -> Float[Tensor, " s"]:
    """The mean settings of the nearest photos: a camera that sees about the same sets itself about
    the same.

    As far as photos tell each other's settings, which is found by leaving each out in turn: the
    mean is scaled by the factor, from 0 to 1, that would have suited the photos left out best.
    Where settings are random, it is near 0.

    Args:
        settings: of each photo, at least one; their mean is 0.
        looks: of each photo.
        look: of the photo in question; if exactly one of those was taken there, it is that one,
            with its own settings.
    """
    distances = _distances([look], looks)
    same = (distances[0] < SAME_PLACE).nonzero()[:, 0]
    if len(same) == 1:
        return settings[same[0]]
    if len(looks) <= NEAREST:
        return torch.zeros_like(settings[0])
    told = _nearest_means(settings, _distances(looks, looks).fill_diagonal_(torch.inf))
    square = told.square().sum(dim=0)
    trust = torch.where(square > 0, (told * settings).sum(dim=0) / square, 0.0).clamp(0, 1)
    return trust * _nearest_means(settings, distances)[0]


def _nearest_means(
    settings: Float[Tensor, "v s"], distances: Float[Tensor, "m v"]
) -> Float[Tensor, "m s"]:
    """The mean of the nearest photos' settings, weighted by the inverse of their distance."""
    near = distances.topk(NEAREST, dim=1, largest=False)
    weights = 1 / near.values.clamp_min(SAME_PLACE)
    return ((weights / weights.sum(dim=1, keepdim=True))[:, :, None] * settings[near.indices]).sum(
        dim=1
    )


def _distances(some: Sequence[Look], others: Sequence[Look]) -> Float[Tensor, "m n"]:
    """How differently photos see the scene: how far apart they were taken, in extents, plus the
    angle between them."""
    positions, directions = _columns(some)
    other_positions, other_directions = _columns(others)
    exact = "donot_use_mm_for_euclid_dist"  # the product form loses its digits far from the origin
    apart = torch.cdist(positions, other_positions, compute_mode=exact)
    return apart + (directions @ other_directions.T).clamp(-1, 1).arccos()


def _columns(looks: Sequence[Look]) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    positions, directions = zip(*looks, strict=True)
    return torch.tensor(positions, dtype=torch.float64), torch.tensor(
        directions, dtype=torch.float64
    )


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
