"""Score renderings of held-out views against their photos and, where there is one, against the
exact truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from torch import Tensor

from mrgs.errors import SceneError
from mrgs.evaluation.figures import (
    RGB_FIGURES,
    THERMAL_FIGURES,
    Figures,
    Missing,
    all_missing,
    mean_figures,
)
from mrgs.evaluation.lpips import MIN_SIDE_PX, Lpips
from mrgs.evaluation.metrics import (
    fill_invalid,
    mean_absolute_error,
    otsu_threshold,
    psnr,
    psnr_matched,
    ssim,
    ssim_pair_range,
)
from mrgs.evaluation.truth import TRUTH_FIGURES, Truth
from mrgs.render import Photograph, Rendering, as_it_is
from mrgs.scene import Pixels, TemperatureRange, View

NO_LPIPS = "no VGG-16 and LPIPS weights were given (--lpips-weights FILE)"
NO_CELSIUS = "the scene has no temperature range, so its values have no °C"


@dataclass(frozen=True)
class ViewMetrics:
    """One view's figures, by the names of ``THERMAL_FIGURES``, ``RGB_FIGURES`` and
    ``TRUTH_FIGURES``."""

    name: str
    thermal: Figures
    rgb: Figures
    truth: Figures | None


@dataclass(frozen=True)
class Metrics:
    """Figures of a set of views.

    Attributes:
        thermal: means over the views that have the figure.
        rgb: the same for the colour images.
        truth: the same against the exact truth; None where the scene has none.
        views: each view's own figures.
    """

    thermal: Figures
    rgb: Figures
    truth: Figures | None
    views: tuple[ViewMetrics, ...]


Visitor: TypeAlias = Callable[[View, Rendering, ViewMetrics], None]


def evaluate(
    views: Sequence[View],
    render: Callable[[View], Rendering],
    temperature: TemperatureRange | None,
    lpips: Lpips | None = None,
    truth: Truth | None = None,
    visit: Visitor | None = None,
    photograph: Photograph = as_it_is,
) -> Metrics:
    """Render each view once and score it at the full frame, on the (undistorted) images that the
    views load.

    Args:
        views: the held-out views.
        render: the model, from a view to its images.
        temperature: the scene's scale; None leaves the figures in °C out.
        lpips: the network; None leaves LPIPS out.
        truth: exact temperatures and depths, see ``Truth.find``.
        visit: called after each view with what was compared with its photos; nothing is kept from
            view to view.
        photograph: from what is there to what the cameras would write, which is compared with the
            photos; the truth is compared with what is there.

    Raises:
        SceneError: there are no views, or an image or a truth file cannot be read.
    """
    if not views:
        raise SceneError(
            "the scene has no views to score: put 'eval' into their file names, or list them in "
            "val_filenames"
        )
    threshold = foreground_threshold(views)
    scored = []
    for view in views:
        rendering = render(view)
        photographed = photograph(rendering, view.cameras[0])
        metrics = _score(view, rendering, photographed, temperature, threshold, lpips, truth)
        scored.append(metrics)
        if visit is not None:
            visit(view, photographed, metrics)
    truths = [metrics.truth for metrics in scored if metrics.truth is not None]
    return Metrics(
        thermal=mean_figures([metrics.thermal for metrics in scored], THERMAL_FIGURES),
        rgb=mean_figures([metrics.rgb for metrics in scored], RGB_FIGURES),
        truth=mean_figures(truths, TRUTH_FIGURES) if truths else None,
        views=tuple(scored),
    )


def foreground_threshold(views: Sequence[View]) -> float | None:
    """Otsu's threshold of each thermal photo's valid pixels, averaged over the photos; normalised
    temperature.

    None where no photo has one (no thermal images, or only uniform ones).
    """
    thresholds = []
    for view in views:
        if view.thermal is None:
            continue
        pixels = view.thermal.load()
        values = pixels.values[..., 0] if pixels.valid is None else pixels.values[pixels.valid]
        threshold = otsu_threshold(values.flatten().numpy()) if values.numel() else None
        if threshold is not None:
            thresholds.append(threshold)
    return float(np.mean(thresholds)) if thresholds else None


def _score(
    view: View,
    rendering: Rendering,
    photographed: Rendering,
    temperature: TemperatureRange | None,
    threshold: float | None,
    lpips: Lpips | None,
    truth: Truth | None,
) -> ViewMetrics:
    thermal = _loaded(view.thermal.load(), photographed.thermal) if view.thermal else None
    rgb = _loaded(view.rgb.load(), photographed.rgb) if view.rgb else None
    rgb_figures = all_missing(
        RGB_FIGURES, "the view has no RGB image, or the model does not render it"
    )
    if rgb is not None and photographed.rgb is not None:
        rgb_figures = _image_figures(photographed.rgb, rgb, lpips)
    thermal_figures = all_missing(
        THERMAL_FIGURES, "the view has no thermal image, or the model does not render it"
    )
    if thermal is not None and photographed.thermal is not None:
        figures = _image_figures(photographed.thermal, thermal, lpips)
        figures |= _temperature_figures(photographed.thermal, thermal, temperature, threshold)
        thermal_figures = {name: figures[name] for name in THERMAL_FIGURES}
    truth_figures = None
    if truth is not None:
        depth = (
            rendering.depth_thermal if rendering.depth_thermal is not None else rendering.depth_rgb
        )
        truth_figures = truth.score(view.name, rendering.thermal, thermal, depth, temperature)
    return ViewMetrics(view.name, thermal_figures, rgb_figures, truth_figures)


def _loaded(pixels: Pixels, rendered: Tensor | None) -> Pixels:
    """The photo on the rendering's device.

    Raises:
        ValueError: the rendering has another size than the photo.
    """
    if rendered is None:
        return pixels
    if rendered.shape != pixels.values.shape:
        raise ValueError(
            f"rendering {tuple(rendered.shape)} and photo {tuple(pixels.values.shape)} differ in "
            f"size"
        )
    valid = None if pixels.valid is None else pixels.valid.to(rendered.device)
    return Pixels(pixels.values.to(rendered), valid)


def _image_figures(image: Tensor, photo: Pixels, lpips: Lpips | None) -> Figures:
    """PSNR and SSIM in both conventions, and LPIPS."""
    target, valid = photo.values, photo.valid
    if valid is not None and not valid.any():
        return all_missing(RGB_FIGURES, "no pixel of the photo is valid")
    figures: Figures = {
        "psnr": psnr(image, target, valid),
        "psnr_matched": psnr_matched(image, target, valid),
        "ssim": ssim(image, target, valid),
        "ssim_pair_range": ssim_pair_range(image, target, valid),
        "lpips": Missing(NO_LPIPS),
    }
    if lpips is not None and min(image.shape[:2]) < MIN_SIDE_PX:
        figures["lpips"] = Missing(f"the images are smaller than {MIN_SIDE_PX} pixels")
    elif lpips is not None:
        figures["lpips"] = lpips(fill_invalid(image.clamp(0, 1), target, valid), target)
    return figures


def _temperature_figures(
    image: Tensor, photo: Pixels, temperature: TemperatureRange | None, threshold: float | None
) -> Figures:
    """MAE in °C over the full frame and over the foreground (photo above ``threshold``,
    normalised)."""
    if temperature is None:
        return all_missing(("mae_c", "mae_foreground_c"), NO_CELSIUS)
    target, valid = photo.values, photo.valid
    if valid is not None and not valid.any():
        return all_missing(("mae_c", "mae_foreground_c"), "no pixel of the photo is valid")
    figures: Figures = {"mae_c": mean_absolute_error(image, target, valid) * temperature.span_c}
    figures["mae_foreground_c"] = Missing("no photo has two classes for Otsu's threshold to part")
    if threshold is not None:
        foreground = target[..., 0] > threshold
        foreground = foreground if valid is None else foreground & valid
        figures["mae_foreground_c"] = Missing(
            "no pixel of the photo is warmer than the mean Otsu threshold"
        )
        if foreground.any():
            figures["mae_foreground_c"] = (
                mean_absolute_error(image, target, foreground) * temperature.span_c
            )
    return figures
