"""An offset per thermal photo: what an uncooled camera drifts by between two corrections with its
shutter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.method.camera_model.photo_gain import PhotoEffect, only_one_at, viewpoint_distances
from mrgs.scene import Pixels
from mrgs.scene.capture import Viewpoint

PARTS = 4
"""Number of parts of a photo across and down."""

NEWEST_SHARE = 0.25
"""Weight of the newest residual in the running mean."""

NORMAL_QUARTILES = 1.349
"""Distance between the quartiles of a normal variable, in standard deviations."""

MEDIAN_LOSS = 1.5708
"""Variance of the median over that of the mean, of many normal variables (π / 2)."""


class PhotoDrift(PhotoEffect):
    """An offset per photo, of sum zero: a random effect, as in the analysis of variance.

    A photo's residual is the median over its parts of what it shows above the model. How far the
    parts differ tells how well it is known: a drift shifts all of a photo alike, a surface that is
    not yet learned does not. Each residual is shrunk by v / (v + τ²), with v its variance and τ²
    the variance of the drift over the photos, estimated by moments (DerSimonian and Laird, 1986).
    τ² is 0, and so are all offsets, where the residuals differ no more than their variances
    explain.
    """

    residuals: Float[Tensor, " p"]
    variances: Float[Tensor, " p"]
    visits: Float[Tensor, " p"]

    def __init__(self, viewpoints: Sequence[Viewpoint | None]) -> None:
        super().__init__(viewpoints)
        self._rows = self.rows.tolist()
        for name in ("residuals", "variances", "visits"):
            self.register_buffer(name, torch.zeros(len(self._viewpoints)))

    def of(self, view: Int64[Tensor, "1"]) -> Float[Tensor, ""]:
        """The offset of a training view's photo, normalised; the view must have one."""
        return self.offsets().index_select(0, self.row_of(view))[0]

    def expected(self, viewpoint: Viewpoint) -> Float[Tensor, ""]:
        """The offset of the photo taken there; 0, which is the mean, for any other place: a drift
        depends on the time, not on the place."""
        same = only_one_at(viewpoint_distances([viewpoint], self._viewpoints)[0])
        return torch.zeros_like(self.residuals[0]) if same is None else self.offsets()[same]

    def offsets(self) -> Float[Tensor, " p"]:
        """The offsets of all photos, normalised."""
        seen = (self.visits > 0).to(self.residuals)
        count = seen.sum().clamp_min(1)
        centred = seen * (self.residuals - (seen * self.residuals).sum() / count)
        spread = (seen * (centred.square() - self.variances)).sum() / count
        drift = spread.clamp_min(0)
        shrunk = centred * drift / (drift + self.variances).clamp_min(torch.finfo().tiny)
        return seen * (shrunk - shrunk.sum() / count)

    def residual(
        self, view: Int64[Tensor, "1"], recorded: Float[Tensor, "h w 1"], photo: Pixels
    ) -> Float[Tensor, "2"]:
        """What a training view's photo shows above its rendering, without the photo's offset, which
        the rendering has; see ``residual_of``."""
        difference = (photo.values - recorded + self.of(view))[:, :, 0]
        if photo.valid is not None:
            difference = torch.where(photo.valid, difference, torch.nan)
        return residual_of(difference)

    @torch.no_grad()
    def learn(self, view: int, residual: Float[Tensor, "2"], finite: Bool[Tensor, ""]) -> None:
        """Take in the residual of a training view's photo; nothing is learned where ``finite`` is
        False."""
        row = self._rows[view]
        middle, variance = residual
        usable = finite & middle.isfinite()
        share = (1 / (self.visits[row] + 1)).clamp_min(NEWEST_SHARE) * usable
        for mean, new in ((self.residuals, middle), (self.variances, variance)):
            mean[row] += share * (new.nan_to_num() - mean[row])
        self.visits[row] += usable


@torch.no_grad()
def residual_of(difference: Float[Tensor, "h w"]) -> Float[Tensor, "2"]:
    """The residual of a photo and its variance, from what it shows above the model, normalised; NaN
    where all of it is masked, which is NaN in the difference."""
    parts = _part_medians(difference)
    quartiles = torch.linspace(0.25, 0.75, 3, device=parts.device)
    low, middle, high = parts.nanquantile(quartiles)
    spread = (high - low) / NORMAL_QUARTILES
    variance = MEDIAN_LOSS * spread.square() / parts.isfinite().sum().clamp_min(1)
    return torch.stack([middle, variance])


def _part_medians(residual: Float[Tensor, "h w"]) -> Float[Tensor, " n"]:
    """The median of each part of an image; NaN where it is masked throughout."""
    height, width = (max(size // PARTS, 1) for size in residual.shape)
    down, across = (min(size, PARTS) for size in residual.shape)
    parts = residual[: down * height, : across * width].reshape(down, height, across, width)
    return parts.transpose(1, 2).reshape(down * across, -1).nanmedian(dim=1).values
