"""Matching of patches of the photo, warped to the thermal camera, in the thermal image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor
from torch.nn import functional

_BORDER_PX = 3
_WHOLE_STEP_PX = 2
_LEAST_SEEN = 0.7
_LEAST_SCORE = 0.3
_MOST_STEP_PX = 1.0
_LEAST_CURVATURE = 1e-5


@dataclass(frozen=True)
class Patches:
    """The layout of the patches; all lengths in pixels of the compared images.

    Attributes:
        sigma: of the Gaussian window.
        spacing: of the patches' centres.
        reach: largest displacement that is searched, in x and in y.
    """

    sigma: float
    spacing: int
    reach: int

    @property
    def independent(self) -> float:
        """Share of the patches with independent errors, because neighbouring windows overlap."""
        return min(1.0, self.spacing**2 / (4 * np.pi * self.sigma**2))


@dataclass(frozen=True, eq=False)
class Masked:
    """The structure of an image [C, H, W], and the mask of its valid pixels (None: all)."""

    values: Float32[np.ndarray, "c h w"]
    seen: Bool[np.ndarray, "h w"] | None = None

    def within_border(self) -> tuple[Float32[Tensor, "c h w"], Float32[Tensor, "h w"]]:
        """The structure, 0 where it is not valid or affected by the image's border; and that mask
        as 0 and 1."""
        mask = torch.zeros(self.values.shape[1:])
        inner = (slice(_BORDER_PX, -_BORDER_PX), slice(_BORDER_PX, -_BORDER_PX))
        mask[inner] = (
            1.0 if self.seen is None else torch.from_numpy(self.seen.astype(np.float32))[inner]
        )
        return torch.from_numpy(self.values) * mask, mask


@dataclass(frozen=True, eq=False)
class Matches:
    """M matched patches; positions in pixels of the compared images.

    Attributes:
        centres: column and row of the patch in the photo's image; whole numbers, between four
            pixels.
        displacements: from there to the matching position in the thermal image.
        information: inverse covariance of the displacement, up to a common factor.
        scores: normalised correlation.
    """

    centres: Float[np.ndarray, "m 2"]
    displacements: Float[np.ndarray, "m 2"]
    information: Float[np.ndarray, "m 2 2"]
    scores: Float[np.ndarray, " m"]

    def sharpest(self, share: float) -> Matches:
        """The share of the patches whose positions are the most certain."""
        if not len(self.scores):
            return self
        sharpness = np.trace(self.information, axis1=1, axis2=2)
        kept = sharpness >= np.quantile(sharpness, 1 - share)
        return Matches(
            self.centres[kept], self.displacements[kept], self.information[kept], self.scores[kept]
        )


def match(
    thermal: Masked,
    photo: Masked,
    patches: Patches,
) -> Matches:
    """Match each patch by normalised correlation of the two structures, to a fraction of a pixel.

    Both are normalised over the pixels that overlap at a displacement: otherwise patches at the
    border would be biased inwards, and the focal length with them. A patch without a maximum within
    reach is left out. The information is the curvature of the correlation s at its maximum times
    s / (1 - s²): the certainty of a maximum whose height is lowered by independent noise.
    """
    scores, share, columns, rows = _scores(thermal, photo, patches)
    ny, nx = share.shape
    flat = scores.reshape(scores.shape[0], scores.shape[1], ny * nx).transpose(2, 0, 1)
    best = flat.reshape(ny * nx, -1).argmax(axis=1)
    i, j = np.unravel_index(best, flat.shape[1:])
    side = 2 * patches.reach + 1
    usable = (share.ravel() > _LEAST_SEEN) & (i > 0) & (i < side - 1) & (j > 0) & (j < side - 1)
    usable &= flat[np.arange(ny * nx), i, j] > _LEAST_SCORE
    kept = np.flatnonzero(usable)
    i, j = i[kept], j[kept]
    around = flat[
        kept[:, None, None],
        i[:, None, None] + _OFFSETS[:, None],
        j[:, None, None] + _OFFSETS[None, :],
    ]
    step, curvature = _vertex(around)
    score = np.minimum(around[:, 1, 1], 0.999).astype(np.float64)
    sharp = np.linalg.eigvalsh(curvature)[:, 0] > _LEAST_CURVATURE
    centres = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)[kept].astype(np.float64)
    displacements = np.column_stack([j, i]) - patches.reach + step
    information = curvature * (score / (1 - score**2))[:, None, None]
    return Matches(centres[sharp], displacements[sharp], information[sharp], score[sharp])


def whole_displacement(thermal: Masked, photo: Masked, reach: int) -> tuple[int, int]:
    """Displacement of the whole thermal image, pixels right and down: the best normalised
    correlation within ``reach`` pixels, in steps of ``_WHOLE_STEP_PX``."""
    here, here_seen = photo.within_border()
    there, there_seen = (functional.pad(values, 4 * [reach]) for values in thermal.within_border())
    here_energy, there_energy = here.square().sum(dim=0), there.square().sum(dim=0)
    height, width = here_seen.shape
    best, place = -1.0, (0, 0)
    steps = range(-(reach // _WHOLE_STEP_PX) * _WHOLE_STEP_PX, reach + 1, _WHOLE_STEP_PX)
    for down in steps:
        for right in steps:
            part = (
                ...,
                slice(reach + down, reach + down + height),
                slice(reach + right, reach + right + width),
            )
            norm = (there_energy[part] * here_seen).sum() * (here_energy * there_seen[part]).sum()
            score = float((there[part] * here).sum() / (norm + 1e-9).sqrt())
            if score > best:
                best, place = score, (right, down)
    return place


_OFFSETS = np.arange(-1, 2)


def _scores(
    thermal: Masked, photo: Masked, patches: Patches
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Correlations [displacement y, displacement x, patch row, patch column], the share of each
    patch that is seen, and the patches' columns and rows."""
    _, height, width = photo.values.shape
    margin = round(1.5 * patches.sigma)
    rows, columns = (np.arange(margin, n - margin + 1, patches.spacing) for n in (height, width))
    across, down = _windows(width, columns, patches.sigma), _windows(height, rows, patches.sigma)

    def pooled(values: Tensor) -> Tensor:
        return down @ values @ across.T

    here, here_seen = photo.within_border()
    there, there_seen = (
        functional.pad(values, 4 * [patches.reach]) for values in thermal.within_border()
    )
    here_energy, there_energy = here.square().sum(dim=0), there.square().sum(dim=0)
    side = 2 * patches.reach + 1
    scores = torch.empty(side, side, len(rows), len(columns))
    for i in range(side):
        for j in range(side):
            part = (..., slice(i, i + height), slice(j, j + width))
            norm = pooled(there_energy[part] * here_seen) * pooled(here_energy * there_seen[part])
            scores[i, j] = pooled((there[part] * here).sum(dim=0)) / (norm + 1e-9).sqrt()
    share = pooled(here_seen) / pooled(torch.ones_like(here_seen))
    return scores.numpy(), share.numpy(), columns, rows


def _windows(count: int, centres: np.ndarray, sigma: float) -> Float32[Tensor, "k n"]:
    offsets = (np.arange(count) + 0.5 - centres[:, None]) / sigma
    weights = np.where(np.abs(offsets) < 2, np.exp(-0.5 * offsets**2), 0.0)
    return torch.from_numpy(weights.astype(np.float32))


def _vertex(
    around: Float[np.ndarray, "m 3 3"],
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2 2"]]:
    """Position (x, y) of the maximum of the parabola through 3×3 values, from their middle, and its
    negated Hessian."""
    a = around.astype(np.float64)
    slope = np.column_stack([a[:, 1, 2] - a[:, 1, 0], a[:, 2, 1] - a[:, 0, 1]]) / 2
    xx = 2 * a[:, 1, 1] - a[:, 1, 2] - a[:, 1, 0]
    yy = 2 * a[:, 1, 1] - a[:, 2, 1] - a[:, 0, 1]
    xy = (a[:, 0, 2] + a[:, 2, 0] - a[:, 2, 2] - a[:, 0, 0]) / 4
    curvature = np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)
    safe = curvature + np.eye(2) * 1e-6
    step = np.linalg.solve(safe, slope[..., None])[..., 0]
    return np.clip(step, -_MOST_STEP_PX, _MOST_STEP_PX), curvature
