"""A shading common to all thermal photos: what a lens and its housing add towards the corners."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mrgs.method.camera_model.photo_drift import NEWEST_SHARE, PARTS

HEIGHT = 0.75
"""Half the height of an image where half its width is 1: about that of all thermal cameras."""

TERMS = 6
"""r², r⁴, x² − y², x y, x, y."""

_PART_SAMPLES = 8
"""Samples of the terms along each side of a part of a photo."""


class PhotoShading(nn.Module):
    """An addend that depends on the place in the image alone, of mean zero over the image: a
    polynomial of low order, which cannot take up a scene's detail. In training it is fitted to the
    mean over the photos of what their parts show above the model; the prior, from the photos'
    overlap, counts by its precision.

    Args:
        fixed: keep the shading as it is given.
    """

    coefficients: Float[Tensor, "6"]
    prior: Float[Tensor, "6"]
    precision: Float[Tensor, "6 6"]
    means: Float[Tensor, " n"]
    squares: Float[Tensor, " n"]
    visits: Float[Tensor, ""]
    part_terms: Float[Tensor, "n 6"]

    def __init__(self, photos: int, fixed: bool = False) -> None:
        super().__init__()
        self.fixed = fixed
        self._least_share = NEWEST_SHARE / max(photos, 1)
        for name, size in {
            "coefficients": (TERMS,), "prior": (TERMS,), "precision": (TERMS, TERMS),
            "means": (PARTS**2,), "squares": (PARTS**2,), "visits": (),
        }.items():  # fmt: skip
            self.register_buffer(name, torch.zeros(size))
        samples = PARTS * _PART_SAMPLES
        terms = shading_terms(*image_places(samples, samples, self.coefficients))
        parts = terms.view(PARTS, _PART_SAMPLES, PARTS, _PART_SAMPLES, TERMS).mean(dim=(1, 3))
        self.register_buffer("part_terms", parts.view(PARTS**2, TERMS), persistent=False)

    def begin(
        self, coefficients: Float[Tensor, "6"], precision: Float[Tensor, "6 6"] | None = None
    ) -> None:
        """Start from a shading that is known with this precision (the inverse of its covariance;
        None where it is fixed), normalised."""
        self.prior.copy_(coefficients)
        self.coefficients.copy_(coefficients)
        if precision is not None:
            self.precision.copy_(precision)

    def forward(self, height: int, width: int) -> Float[Tensor, "h w 1"]:
        """The shading of an image of this size, normalised."""
        x, y = image_places(height, width, self.coefficients)
        return (shading_terms(x, y) @ self.coefficients)[..., None]

    @torch.no_grad()
    def learn(self, parts: Float[Tensor, " n"], finite: Bool[Tensor, ""]) -> None:
        """Take in what the parts of a photo show above the model with its shading and the photo's
        offset, NaN where they are masked; nothing is learned where ``finite`` is False."""
        if self.fixed or len(parts) != len(self.means):
            return
        shown = parts + self.part_terms @ self.coefficients
        usable = finite & shown.isfinite()
        share = (1 / (self.visits + 1)).clamp_min(self._least_share)
        for mean, new in ((self.means, shown), (self.squares, shown.square())):
            mean += share * torch.where(usable, new - mean, 0)
        self.visits += finite
        # Not divided by the number of photos: what the model has not learned yet is alike in many.
        variance = NEWEST_SHARE * (self.squares - self.means.square()).clamp_min(0).mean()
        weight = variance * self.precision
        found, _ = torch.linalg.solve_ex(
            self.part_terms.T @ self.part_terms + weight,
            self.part_terms.T @ self.means + weight @ self.prior,
        )
        self.coefficients.copy_(torch.where(self.visits > 0, found, self.coefficients))


def image_places(
    height: int, width: int, like: Tensor
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """x and y of the pixels of an image: from -1 to 1 across, ``HEIGHT`` times that down; on the
    device and in the precision of ``like``."""
    across, down = (
        (torch.arange(size, device=like.device, dtype=like.dtype) + 0.5) * (2 / size) - 1
        for size in (width, height)
    )
    y, x = torch.meshgrid(HEIGHT * down, across, indexing="ij")
    return x, y


def shading_terms(
    x: Float[Tensor, "*places"], y: Float[Tensor, "*places"]
) -> Float[Tensor, "*places 6"]:
    """The terms of the shading at places of an image, each of mean zero over it."""
    u, v, h = x.square(), y.square(), HEIGHT**2
    r2 = u + v
    terms = [
        r2 - (1 + h) / 3,
        r2.square() - (1 / 5 + 2 * h / 9 + h**2 / 5),
        u - v - (1 - h) / 3,
        x * y,
        x,
        y,
    ]
    return torch.stack(terms, dim=-1)
