"""Image metrics on [H, W, C] tensors with values in [0, 1].

All take an optional mask of valid pixels and count nothing outside it. PSNR, SSIM and LPIPS clamp
the rendering to [0, 1] first, as the images that one can look at are; the temperature errors do
not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.method.losses.ssim import RADIUS_PX, ssim_map
from mrgs.scene import BUILT_IN, THERMAL, Modality, Pixels, View, metric_first

Image: TypeAlias = Float[Tensor, "h w c"]
Mask: TypeAlias = Bool[Tensor, "h w"]

PIXEL_FIGURES = ("psnr", "psnr_matched", "ssim", "ssim_pair_range")
CELSIUS_FIGURES = ("mae_c", "mae_offset_c", "mae_foreground_c")

REPORTED = metric_first(BUILT_IN)
"""The modalities that every report lists, in its order; others follow."""


def figure_names(modality: Modality) -> tuple[str, ...]:
    """Names of the figures that images of a modality are scored by."""
    celsius = CELSIUS_FIGURES if modality == THERMAL else ()
    return (*PIXEL_FIGURES, *celsius, "lpips")


class Missing(NamedTuple):
    """A missing figure. The reason is a clause without a full stop."""

    reason: str


Figure: TypeAlias = float | Missing
Figures: TypeAlias = dict[str, float | Missing]


def all_missing(names: Iterable[str], reason: str) -> Figures:
    """Figures of these names, all missing for one reason."""
    return {name: Missing(reason) for name in names}


def mean_figure(figures: Sequence[Figure]) -> Figure:
    """Mean of one figure over the views that have it; missing, with the first view's reason, if no
    view has it.

    An infinite figure (the PSNR of identical images) makes the mean infinite: leaving it out would
    understate it.
    """
    numbers = [figure for figure in figures if not isinstance(figure, Missing)]
    if not numbers:
        return figures[0] if figures else Missing("no view to score")
    return math.fsum(numbers) / len(numbers) if all(map(math.isfinite, numbers)) else sum(numbers)


def mean_figures(views: Sequence[Figures], names: Iterable[str]) -> Figures:
    """Mean over the views of each named figure, see ``mean_figure``."""
    return {name: mean_figure([view[name] for view in views]) for name in names}


def to_json(figure: Figure) -> tuple[float | None, str | None]:
    """A figure as (number, None), or as (None, reason) if it is missing, NaN or infinite, which
    JSON cannot express."""
    if isinstance(figure, Missing):
        return None, figure.reason
    if math.isnan(figure):
        return None, "not a number: the rendering holds NaN"
    if figure == math.inf:
        return None, "infinite: the images are identical"
    if figure == -math.inf:
        return None, "not finite: the rendering overflows"
    return float(figure), None


BORDER = 0.05
"""Width of the border that the background reaches, as a share of each side."""


def psnr(image: Image, target: Image, valid: Mask | None = None) -> float:
    """Peak signal-to-noise ratio for the range 1, dB; infinite for identical valid pixels."""
    difference = _select(image.clamp(0, 1), valid).double() - _select(target, valid).double()
    mse = difference.square().mean().item()
    return math.inf if mse == 0 else -10 * math.log10(mse)


def psnr_matched(image: Image, target: Image, valid: Mask | None = None) -> Figure:
    """PSNR after each channel of the rendering has taken the gain and the offset that bring it
    closest to the target.

    For cameras that expose or scale each photo by itself: what they chose for a held-out photo no
    model can know. Least squares over the valid pixels, with gains of 0 or more. Missing where the
    target is uniform: every rendering can be brought to that.
    """
    low, high = _select(target, valid).flatten(0, -2).aminmax(dim=0)
    if torch.equal(low, high):
        return Missing("the photo is uniform, so gain and offset can turn every rendering into it")
    channels = [
        _matched(rendered.double(), photo.double(), valid)
        for rendered, photo in zip(image.clamp(0, 1).unbind(2), target.unbind(2), strict=True)
    ]
    return psnr(torch.stack(channels, dim=2), target, valid)


def mean_absolute_error(
    image: Float[Tensor, "*shape"], target: Float[Tensor, "*shape"], valid: Mask | None = None
) -> float:
    """Mean of |image − target| over the valid pixels, in the input's unit; NaN if none is valid."""
    return (_select(image, valid).double() - _select(target, valid).double()).abs().mean().item()


def mean_absolute_error_after_offset(
    image: Float[Tensor, "*shape"], target: Float[Tensor, "*shape"], valid: Mask | None = None
) -> float:
    """``mean_absolute_error`` after the offset that makes it smallest, the median difference.

    For cameras that drift: how much the camera had drifted in a held-out photo no model can know.
    """
    difference = _select(image, valid).double() - _select(target, valid).double()
    return (difference - difference.median()).abs().mean().item()


def ssim(image: Image, target: Image, valid: Mask | None = None) -> float:
    """SSIM as the 3DGS family reports it: data range 1, zeros beyond the border, mean over the
    valid pixels.

    Outside the valid pixels the rendering takes the photo's values, so that no window compares
    them.
    """
    similarity = ssim_map(*_planes(image, target, valid), data_range=1.0)
    return _select(similarity.permute(1, 2, 0), valid).mean().item()


def ssim_pair_range(image: Image, target: Image, valid: Mask | None = None) -> Figure:
    """SSIM with the data range of the image pair, torchmetrics' default, over windows that lie
    inside the image.

    torchmetrics averages over these windows up to 1.4.1 (2024); later releases also count the
    reflected borders. Missing where both images are uniform, or where no valid pixel has a whole
    window.
    """
    interior = torch.zeros(image.shape[:2], dtype=torch.bool, device=image.device)
    interior[RADIUS_PX:-RADIUS_PX, RADIUS_PX:-RADIUS_PX] = True
    interior = interior if valid is None else interior & valid
    if not interior.any():
        return Missing("no valid pixel is far enough from the border for a whole 11×11 window")
    pixels = (
        torch.stack([_select(image.clamp(0, 1), valid), _select(target, valid)]).double().flatten(1)
    )
    data_range = (pixels.amax(dim=1) - pixels.amin(dim=1)).max()
    if data_range == 0:
        return Missing("both images are uniform, so the range of the pair is zero")
    similarity = ssim_map(*_planes(image, target, valid), data_range=data_range)
    return _select(similarity.permute(1, 2, 0), interior).mean().item()


def fill_invalid(image: Image, target: Image, valid: Mask | None) -> Image:
    """The image with the target's values where pixels are not valid."""
    return image if valid is None else image.where(valid[..., None], target)


def otsu_threshold(values: Float[np.ndarray, " n"]) -> float | None:
    """Otsu's threshold, which parts values into two classes.

    It maximises the between-class variance over the histogram (N. Otsu, "A threshold selection
    method from gray-level histograms", 1979); among equals the lowest wins. None if all values are
    equal.
    """
    low, high = float(values.min()), float(values.max())
    if not low < high:
        return None
    counts, edges = np.histogram(values, bins=256, range=(low, high))
    centres = (edges[:-1] + edges[1:]) / 2
    below, total = np.cumsum(counts)[:-1], counts.sum()
    moment_below = np.cumsum(counts * centres)[:-1]
    mean_below = moment_below / below
    mean_above = ((counts * centres).sum() - moment_below) / (total - below)
    return float(edges[1 + np.argmax(below * (total - below) * (mean_below - mean_above) ** 2)])


@dataclass(frozen=True)
class Foreground:
    """Which temperatures are the object's: above the threshold (normalised) if the object
    ``is_warm``, else below it, as of an ice cup."""

    threshold: float
    is_warm: bool

    @classmethod
    def find(cls, views: Sequence[View]) -> Foreground | None:
        """The foreground of a set of thermal photos.

        The threshold is Otsu's of each photo's valid pixels, averaged over the photos. Of both
        sides the object is the one that covers less of the photos' borders: an object is
        photographed as a whole, from all around. None where no photo has a threshold: no thermal
        photos, or only uniform ones."""
        found, borders = [], []
        for view in views:
            if THERMAL not in view.images:
                continue
            photo = view.images[THERMAL].load()  # one at a time: there may be hundreds
            values = valid_values(photo)
            threshold = otsu_threshold(values.numpy()) if len(values) else None
            found += [] if threshold is None else [threshold]
            borders.append(valid_values(photo, border_of(photo)))
        if not found:
            return None
        threshold, border = float(np.mean(found)), torch.cat(borders)
        at_border = (border > threshold).double().mean().item() if len(border) else 0.0
        return cls(threshold, is_warm=at_border <= 0.5)

    def of(self, photo: Pixels) -> Mask:
        """The valid pixels that belong to the object."""
        warm = photo.values[..., 0] > self.threshold
        mask = warm if self.is_warm else ~warm
        return mask if photo.valid is None else mask & photo.valid


def border_of(photo: Pixels) -> Mask:
    """The pixels along the four sides, ``BORDER`` of a side wide and at least one pixel."""
    height, width = photo.values.shape[:2]
    rows, columns = max(1, round(BORDER * height)), max(1, round(BORDER * width))
    border = torch.ones(height, width, dtype=torch.bool)
    border[rows:-rows, columns:-columns] = False
    return border


def valid_values(photo: Pixels, among: Mask | None = None) -> Float[Tensor, " n"]:
    """Normalised temperatures of the valid pixels, or of those among some."""
    chosen = torch.ones(photo.values.shape[:2], dtype=torch.bool) if among is None else among
    if photo.valid is not None:
        chosen = chosen & photo.valid
    return photo.values[..., 0][chosen]


def _matched(
    image: Float[Tensor, "h w"], target: Float[Tensor, "h w"], valid: Tensor | None
) -> Float[Tensor, "h w"]:
    """The image with the gain, at least 0, and the offset of least squares."""
    inside, goal = _select(image, valid), _select(target, valid)
    variance = inside.var(correction=0)
    covariance = ((inside - inside.mean()) * (goal - goal.mean())).mean()
    gain = torch.where(variance > 0, covariance / variance, 0.0).clamp_min(0)
    return gain * (image - inside.mean()) + goal.mean()


def _select(image: Tensor, valid: Tensor | None) -> Tensor:
    return image if valid is None else image[valid]


def _planes(image: Tensor, target: Tensor, valid: Tensor | None) -> tuple[Tensor, Tensor]:
    """Both images as [C, H, W] in float64: a variance is a small difference of large numbers."""
    filled = fill_invalid(image.clamp(0, 1), target, valid)
    return filled.double().permute(2, 0, 1), target.double().permute(2, 0, 1)
