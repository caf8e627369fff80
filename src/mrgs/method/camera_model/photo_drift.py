"""An offset per thermal photo: the drift of an uncooled camera between two shutter corrections."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
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

NEARLY_SAME_PLACE = 0.01
"""Held-out photos this close to a photo's viewpoint are that photo: it may have been aligned."""


class PhotoDrift(PhotoEffect):
    """An offset per photo, of sum zero: a random effect, as in the analysis of variance.

    A photo's residual is the median over its parts of what it shows above the model; the less they
    differ, the better it is known. What the photos' overlap says before the training counts by its
    precision. Each residual is shrunk by v / (v + τ²), with v its variance and τ² that of the drift
    over the photos, estimated by moments (DerSimonian and Laird, 1986); τ² and all offsets are 0
    where the variances explain the residuals."""

    residuals: Float[Tensor, " p"]
    variances: Float[Tensor, " p"]
    visits: Float[Tensor, " p"]
    priors: Float[Tensor, " p"]
    precisions: Float[Tensor, " p"]

    def __init__(
        self,
        viewpoints: Sequence[Viewpoint | None],
        minutes: Sequence[float | None] = (),
        held_out: Sequence[tuple[Viewpoint, float]] = (),
    ) -> None:
        super().__init__(viewpoints)
        given = [at for point, at in zip(viewpoints, minutes, strict=False) if point is not None]
        known = given or [None] * len(self._viewpoints)
        self.minutes = np.array([np.nan if at is None else at for at in known])
        self._held_out = held_out
        self._rows = self.rows.tolist()
        for name in ("residuals", "variances", "visits", "priors", "precisions"):
            self.register_buffer(name, torch.zeros(len(self._viewpoints)))

    def begin(self, offsets: Float[Tensor, " p"], precisions: Float[Tensor, " p"]) -> None:
        """Start from offsets that are known with these precisions (1 / variance), normalised."""
        self.priors.copy_(offsets)
        self.precisions.copy_(precisions)

    def of(self, view: Int64[Tensor, "1"]) -> Float[Tensor, ""]:
        """The offset of a training view's photo, normalised; the view must have one."""
        return self.offsets().index_select(0, self.row_of(view))[0]

    def expected(self, viewpoint: Viewpoint) -> Float[Tensor, ""]:
        """The offset of the photo taken there; of a held-out photo, that between the photos before
        and after it. 0, which is the mean, for any other place: a drift depends on the time, not on
        the place."""
        same = only_one_at(viewpoint_distances([viewpoint], self._viewpoints)[0])
        if same is not None:
            return self.offsets()[same]
        timed = np.flatnonzero(np.isfinite(self.minutes))
        if not self._held_out or len(timed) == 0:
            return torch.zeros_like(self.residuals[0])
        places, minutes = zip(*self._held_out, strict=True)
        distances = viewpoint_distances([viewpoint], places)[0]
        if distances.min() > NEARLY_SAME_PLACE:
            return torch.zeros_like(self.residuals[0])
        order = timed[np.argsort(self.minutes[timed], kind="stable")]
        between = self.offsets()[order].numpy(force=True)
        at = minutes[int(distances.argmin())]
        return self.residuals.new_tensor(np.interp(at, self.minutes[order], between))

    def offsets(self) -> Float[Tensor, " p"]:
        """The offsets of all photos, normalised."""
        tiny = torch.finfo().tiny
        learned = (self.visits > 0) / self.variances.clamp_min(tiny)
        precisions = learned + self.precisions
        residuals = learned * self.residuals + self.precisions * self.priors
        residuals = residuals / precisions.clamp_min(tiny)
        seen = (precisions > 0).to(residuals)
        variances = seen / precisions.clamp_min(tiny)
        count = seen.sum().clamp_min(1)
        centred = seen * (residuals - (seen * residuals).sum() / count)
        spread = (seen * (centred.square() - variances)).sum() / count
        drift = spread.clamp_min(0)
        shrunk = centred * drift / (drift + variances).clamp_min(tiny)
        return seen * (shrunk - shrunk.sum() / count)

    @torch.no_grad()
    def learn(self, view: int, parts: Float[Tensor, " n"], finite: Bool[Tensor, ""]) -> None:
        """Take in what the parts of a training view's photo show above the model with its offset;
        nothing is learned where ``finite`` is False."""
        row = self._rows[view]
        middle, variance = residual_of(parts + self.offsets()[row])
        usable = finite & middle.isfinite()
        share = (1 / (self.visits[row] + 1)).clamp_min(NEWEST_SHARE) * usable
        for mean, new in ((self.residuals, middle), (self.variances, variance)):
            mean[row] += share * (new.nan_to_num() - mean[row])
        self.visits[row] += usable


@torch.no_grad()
def residual_of(parts: Float[Tensor, " n"]) -> Float[Tensor, "2"]:
    """The residual of a photo and its variance, from what its parts show above the model,
    normalised; NaN where all are masked."""
    quartiles = torch.linspace(0.25, 0.75, 3, device=parts.device)
    low, middle, high = parts.nanquantile(quartiles)
    spread = (high - low) / NORMAL_QUARTILES
    variance = MEDIAN_LOSS * spread.square() / parts.isfinite().sum().clamp_min(1)
    return torch.stack([middle, variance])


@torch.no_grad()
def part_medians(recorded: Float[Tensor, "h w 1"], photo: Pixels) -> Float[Tensor, " n"]:
    """What each part of a photo shows above its rendering as recorded, the median, normalised; NaN
    where a part is masked throughout."""
    residual = (photo.values - recorded)[:, :, 0]
    if photo.valid is not None:
        residual = torch.where(photo.valid, residual, torch.nan)
    height, width = (max(size // PARTS, 1) for size in residual.shape)
    down, across = (min(size, PARTS) for size in residual.shape)
    parts = residual[: down * height, : across * width].reshape(down, height, across, width)
    return parts.transpose(1, 2).reshape(down * across, -1).nanmedian(dim=1).values
