"""Score renderings of held-out views against their photos and, where there is one, against the
exact truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from torch import Tensor

from mrgs.errors import SceneError
from mrgs.evaluation.figures import (
    CELSIUS_FIGURES,
    REPORTED,
    Figure,
    Figures,
    Missing,
    all_missing,
    figure_names,
    mean_figures,
)
from mrgs.evaluation.lpips import MIN_SIDE_PX, Lpips
from mrgs.evaluation.metrics import (
    Foreground,
    fill_invalid,
    mean_absolute_error,
    psnr,
    psnr_matched,
    ssim,
    ssim_pair_range,
)
from mrgs.evaluation.truth import TRUTH_FIGURES, Truth
from mrgs.scene import (
    THERMAL,
    CameraResponse,
    Modality,
    Pixels,
    Rendering,
    TemperatureRange,
    View,
    ideal_cameras,
    in_order,
)
from mrgs.system.memory import give_back_freed

NO_LPIPS = "no VGG-16 and LPIPS weights were given"
NO_CELSIUS = "the scene has no temperature range, so its values have no °C"


@dataclass(frozen=True)
class ViewMetrics:
    """The figures of one view.

    Attributes:
        name: the view's.
        figures: of each modality, by the names of ``figure_names``.
        truth: against the exact truth, by the names of ``TRUTH_FIGURES``; None where the scene has
            none.
    """

    name: str
    figures: Mapping[Modality, Figures]
    truth: Figures | None


@dataclass(frozen=True)
class Metrics:
    """The figures of a set of views.

    Attributes:
        mean: of each modality, means over the views that have the figure.
        truth: means over the views of the figures against the exact truth; None where the scene
            has none.
        views: each view's own figures.
        pose_error_px: distance of a typical held-out photo from what the model shows, pixels of the
            photo; None if not inspected.
        aligned: the figures with each photo aligned with the model; None if the poses are right.
    """

    mean: Mapping[Modality, Figures]
    truth: Figures | None
    views: tuple[ViewMetrics, ...]
    pose_error_px: float | None = None
    aligned: Metrics | None = None


Visitor: TypeAlias = Callable[[View, Rendering, ViewMetrics], None]


def evaluate(
    views: Sequence[View],
    render: Callable[[View], Rendering],
    temperature: TemperatureRange | None,
    lpips: Lpips | None = None,
    truth: Truth | None = None,
    visit: Visitor | None = None,
    camera_response: CameraResponse = ideal_cameras,
) -> Metrics:
    """Render each view once and score it at the full frame, on the (undistorted) images that the
    views load.

    Args:
        views: the held-out views.
        render: the model, from a view to its images.
        temperature: the scene's scale; None leaves the figures in °C out.
        lpips: the network; None leaves LPIPS out.
        truth: exact temperatures and depths, see ``Truth.find``.
        visit: called after each view with the images that were compared with its photos.
        camera_response: from the rendering to what the cameras record, which is compared with the
            photos; the truth is compared with the rendering.

    Raises:
        SceneError: there are no views, or an image or a truth file cannot be read.
    """
    if not views:
        raise SceneError(
            "the scene has no views to score: put 'eval' into their file names, or list them in "
            "val_filenames; for a scene from arrays, give eval_every="
        )
    measure = _Measure(temperature, Foreground.find(views), lpips)
    modalities = scored_modalities(views)
    scored = []
    for view in views:
        rendering = render(view)
        observed = camera_response(rendering, view.camera)
        photos = _photos(view, observed)
        figures = {each: measure.figures(each, photos.get(each), observed) for each in modalities}
        exact = None if truth is None else _score_truth(truth, view, rendering, photos, temperature)
        metrics = ViewMetrics(view.name, figures, exact)
        scored.append(metrics)
        if visit is not None:
            visit(view, observed, metrics)
        give_back_freed()  # else each view leaves gaps of some MB, and there may be hundreds
    return _averaged(scored, modalities)


def _averaged(scored: Sequence[ViewMetrics], modalities: Sequence[Modality]) -> Metrics:
    """The views' figures and their means."""
    mean = {
        modality: mean_figures(
            [metrics.figures[modality] for metrics in scored], figure_names(modality)
        )
        for modality in modalities
    }
    truths = [metrics.truth for metrics in scored if metrics.truth is not None]
    return Metrics(mean, mean_figures(truths, TRUTH_FIGURES) if truths else None, tuple(scored))


def scored_modalities(views: Sequence[View]) -> tuple[Modality, ...]:
    """The modalities to score: those of ``REPORTED``, which every report lists, then all others of
    the views."""
    found = in_order(modality for view in views for modality in view.images)
    return tuple(dict.fromkeys((*REPORTED, *found)))


def _photos(view: View, rendering: Rendering) -> dict[Modality, Pixels]:
    """The view's photos on the rendering's device.

    Raises:
        SceneError: an image cannot be read.
        ValueError: the rendering has another size than a photo.
    """
    return {
        modality: _on_device(image.load(), rendering, modality)
        for modality, image in view.images.items()
    }


def _on_device(pixels: Pixels, rendering: Rendering, modality: Modality) -> Pixels:
    if modality not in rendering:
        return pixels
    image = rendering[modality].image
    if image.shape != pixels.values.shape:
        raise ValueError(
            f"rendering {tuple(image.shape)} and photo {tuple(pixels.values.shape)} differ in size"
        )
    valid = None if pixels.valid is None else pixels.valid.to(image.device)
    return Pixels(pixels.values.to(image), valid)


class _Measure(NamedTuple):
    """What the figures of all views depend on.

    Attributes:
        temperature: the scene's scale; None without °C.
        foreground: of the thermal photos; None where they have none.
        lpips: the network; None leaves LPIPS out.
    """

    temperature: TemperatureRange | None
    foreground: Foreground | None
    lpips: Lpips | None

    def figures(self, modality: Modality, photo: Pixels | None, rendering: Rendering) -> Figures:
        """The figures of one modality in one view, by ``figure_names``."""
        names = figure_names(modality)
        if photo is None or modality not in rendering:
            return all_missing(
                names, f"the view has no {modality.title} image, or the model does not render it"
            )
        if photo.valid is not None and not photo.valid.any():
            return all_missing(names, "no pixel of the photo is valid")
        image = rendering[modality].image
        figures = _pixel_figures(image, photo) | {"lpips": _lpips(image, photo, self.lpips)}
        if modality == THERMAL:
            figures |= _temperature_figures(image, photo, self.temperature, self.foreground)
        return {name: figures[name] for name in names}


def _score_truth(
    truth: Truth,
    view: View,
    rendering: Rendering,
    photos: Mapping[Modality, Pixels],
    temperature: TemperatureRange | None,
) -> Figures:
    """The rendering against the exact truth, which the thermal camera saw."""
    thermal = rendering[THERMAL].image if THERMAL in rendering else None
    seen = rendering.with_depth(THERMAL)
    depth = None if seen is None else rendering.surface_depth(seen)
    return truth.score(view.name, thermal, photos.get(THERMAL), depth, temperature)


def _pixel_figures(image: Tensor, photo: Pixels) -> Figures:
    """PSNR and SSIM in both conventions."""
    target, valid = photo.values, photo.valid
    return {
        "psnr": psnr(image, target, valid),
        "psnr_matched": psnr_matched(image, target, valid),
        "ssim": ssim(image, target, valid),
        "ssim_pair_range": ssim_pair_range(image, target, valid),
    }


def _lpips(image: Tensor, photo: Pixels, lpips: Lpips | None) -> Figure:
    if lpips is None:
        return Missing(NO_LPIPS)
    if image.shape[2] not in (1, 3):
        return Missing("VGG-16 sees one or three channels")
    if min(image.shape[:2]) < MIN_SIDE_PX:
        return Missing(f"the images are smaller than {MIN_SIDE_PX} pixels")
    return lpips(fill_invalid(image.clamp(0, 1), photo.values, photo.valid), photo.values)


def _temperature_figures(
    image: Tensor,
    photo: Pixels,
    temperature: TemperatureRange | None,
    foreground: Foreground | None,
) -> Figures:
    """MAE in °C over the full frame and over the foreground."""
    if temperature is None:
        return all_missing(CELSIUS_FIGURES, NO_CELSIUS)
    figures: Figures = {
        "mae_c": mean_absolute_error(image, photo.values, photo.valid) * temperature.span_c,
        "mae_foreground_c": Missing("no photo has two classes for Otsu's threshold to part"),
    }
    if foreground is not None:
        mask = foreground.of(photo)
        figures["mae_foreground_c"] = (
            mean_absolute_error(image, photo.values, mask) * temperature.span_c
            if mask.any()
            else Missing("no pixel of the photo belongs to the foreground")
        )
    return figures
