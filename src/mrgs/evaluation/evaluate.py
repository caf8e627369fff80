"""Score renderings of held-out views against their photos and, where there is one, against the
exact truth; and what the views lose without each part of the paper."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float32
from PIL import Image
from torch import Tensor

from mrgs.data.images import read_float_tiff
from mrgs.errors import SceneError
from mrgs.evaluation.lpips import MIN_SIDE_PX, Lpips
from mrgs.evaluation.metrics import (
    CELSIUS_FIGURES,
    REPORTED,
    Figure,
    Figures,
    Foreground,
    Missing,
    all_missing,
    figure_names,
    fill_invalid,
    mean_absolute_error,
    mean_absolute_error_after_offset,
    mean_figures,
    psnr,
    psnr_matched,
    ssim,
    ssim_pair_range,
)
from mrgs.method.parts import PartSpreads, knock_outs, part_spreads
from mrgs.runs.open import Run
from mrgs.scene import (
    BUILT_IN,
    THERMAL,
    CameraResponse,
    Modality,
    Pixels,
    Rendering,
    Scene,
    TemperatureRange,
    View,
    ideal_cameras,
    in_order,
)
from mrgs.system.memory import give_back_freed

NO_LPIPS = "no VGG-16 and LPIPS weights were given or kept (docs/runs.md)"
NO_CELSIUS = "the scene has no temperature range, so its values have no °C"

TRUTH_FIGURES = ("mae_c", "camera_mae_c", "depth_median_relative_error")


@dataclass(frozen=True)
class Truth:
    """The exact truth of a generated scene, which no camera has blurred or rounded; its files are
    read when a view is scored.

    ``SCENE/truth/temperature/NAME.tiff`` has °C and ``SCENE/truth/depth/NAME.tiff`` z-depth in
    metres (the scene's unit), both float32 and seen from the thermal camera of the view NAME.
    Temperatures that are not finite and depths that are not finite and positive (sky) are left out.
    """

    folder: Path

    @classmethod
    def of(cls, scene: Scene) -> Truth | None:
        """The exact truth of a scene; None if there is none, as for every real capture, or if it
        was made from arrays."""
        path = Path(scene.path)
        folder = (path.parent if path.is_file() else path) / "truth"
        return cls(folder) if scene.path and folder.is_dir() else None

    def score(
        self,
        name: str,
        thermal: Float[Tensor, "h w 1"] | None,
        photo: Pixels | None,
        depth: Float[Tensor, "h w"] | None,
        temperature: TemperatureRange | None,
    ) -> Figures:
        """Score one view against the exact truth. SceneError if a truth file is damaged, or lies
        outside the scene. ``thermal`` are the rendered normalised temperatures and ``depth`` that
        of the surface which the thermal camera sees, scene units, NaN where it sees none, which
        counts as an infinite error; None where the model renders none. The figures are ``mae_c``:
        |rendered − exact temperature|, mean over the frame; ``camera_mae_c``: |photo − exact
        temperature|, the error of the camera itself; and ``depth_median_relative_error``: median of
        |rendered − exact| / exact."""
        figures = all_missing(
            TRUTH_FIGURES, "the view has no thermal image, or the scene has no °C"
        )
        if temperature is not None and thermal is not None:
            figures["mae_c"] = self._temperature_error(name, thermal, None, temperature)
        if temperature is not None and photo is not None:
            figures["camera_mae_c"] = self._temperature_error(
                name, photo.values, photo.valid, temperature
            )
        figures["depth_median_relative_error"] = self._depth_error(name, depth)
        return figures

    def _temperature_error(
        self, name: str, thermal: Tensor, valid: Tensor | None, temperature: TemperatureRange
    ) -> Figure:
        exact = self.read("temperature", name, (thermal.shape[0], thermal.shape[1]))
        if isinstance(exact, Missing):
            return exact
        known = exact.isfinite() if valid is None else exact.isfinite() & valid.cpu()
        if not known.any():
            return Missing(f"no pixel of truth/temperature/{name}.tiff has a temperature")
        return mean_absolute_error(temperature.to_celsius(thermal[..., 0]).cpu(), exact, known)

    def _depth_error(self, name: str, depth: Tensor | None) -> Figure:
        if depth is None:
            return Missing("the model renders no depth")
        exact = self.read("depth", name, (depth.shape[0], depth.shape[1]))
        if isinstance(exact, Missing):
            return exact
        known = exact.isfinite() & (exact > 0)
        if not known.any():
            return Missing(f"no pixel of truth/depth/{name}.tiff has a depth")
        errors = (depth.detach().cpu()[known] - exact[known]).abs() / exact[known]
        median = float(np.median(errors.nan_to_num(nan=math.inf).numpy()))
        return median if math.isfinite(median) else Missing("most pixels show no surface")

    def read(
        self, kind: str, name: str, shape: tuple[int, int]
    ) -> Float32[Tensor, "h w"] | Missing:
        """The truth of one view at the size of a rendering; averaged over areas where that is
        smaller. SceneError if the file is damaged, or lies outside the scene. The ``kind`` is
        ``temperature`` (°C) or ``depth`` (z-depth, metres)."""
        path = self.folder / kind / f"{name}.tiff"
        if not path.resolve().is_relative_to(self.folder.resolve()):
            raise SceneError(f"{path} lies outside {self.folder}: rename the view")
        if not path.is_file():
            return Missing(f"there is no truth/{kind}/{name}.tiff")
        exact = read_float_tiff(path)
        height, width = exact.shape
        if (height, width) != shape:
            if (
                shape[0] > height
                or shape[1] > width
                or abs(shape[0] * width - shape[1] * height) > max(width, height)
            ):
                return Missing(
                    f"truth/{kind} is {width}×{height}, the rendering {shape[1]}×{shape[0]}"
                )
            exact = np.asarray(
                Image.fromarray(exact).resize((shape[1], shape[0]), Image.Resampling.BOX)
            )
        return torch.from_numpy(np.array(exact))


@dataclass(frozen=True)
class ViewMetrics:
    """The figures of one view: of each modality, by the names of ``figure_names``, and against the
    exact truth, by those of ``TRUTH_FIGURES``; None where the scene has none."""

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
    views load. SceneError if there are no views, or an image or a truth file cannot be read.

    Args:
        render: the model, from a view to its images.
        temperature: the scene's scale; None leaves the figures in °C out.
        truth: exact temperatures and depths, compared with the rendering; see ``Truth.of``.
        visit: called after each view with the images that were compared with its photos.
        camera_response: from the rendering to what the cameras record, which is compared with the
            photos.
    """
    if not views:
        raise SceneError(
            "the scene has no views to score: put 'eval' into their file names, or list them in "
            "val_filenames; for a scene from arrays, give eval_every="
        )
    measure = _Measure(temperature, Foreground.find(views), lpips)
    found = in_order(modality for view in views for modality in view.images)
    modalities = tuple(dict.fromkeys((*REPORTED, *found)))
    scored = []
    for view in views:
        rendering = render(view)
        observed = camera_response(rendering, view.camera)
        photos = _photos(view, observed)
        figures = {each: measure.figures(each, photos.get(each), observed) for each in modalities}
        exact = None
        if truth is not None:  # what the thermal camera saw
            thermal = rendering[THERMAL].image if THERMAL in rendering else None
            seen = rendering.with_depth(THERMAL)
            depth = None if seen is None else rendering.surface_depth(seen)
            exact = truth.score(view.name, thermal, photos.get(THERMAL), depth, temperature)
        metrics = ViewMetrics(view.name, figures, exact)
        scored.append(metrics)
        if visit is not None:
            visit(view, observed, metrics)
        give_back_freed()  # else each view leaves gaps of some MB, and there may be hundreds
    mean = {
        each: mean_figures([metrics.figures[each] for metrics in scored], figure_names(each))
        for each in modalities
    }
    truths = [metrics.truth for metrics in scored if metrics.truth is not None]
    return Metrics(mean, mean_figures(truths, TRUTH_FIGURES) if truths else None, tuple(scored))


def _photos(view: View, rendering: Rendering) -> dict[Modality, Pixels]:
    """The view's photos, on the device of the rendering that they are compared with."""
    photos = {modality: image.load() for modality, image in view.images.items()}
    for modality, photo in photos.items():
        if modality in rendering:
            image = rendering[modality].image
            if image.shape != photo.values.shape:
                sizes = f"rendering {tuple(image.shape)} and photo {tuple(photo.values.shape)}"
                raise ValueError(f"{sizes} differ in size")
            valid = None if photo.valid is None else photo.valid.to(image.device)
            photos[modality] = Pixels(photo.values.to(image), valid)
    return photos


class _Measure(NamedTuple):
    """What the figures of all views depend on: the scene's scale, the foreground of its thermal
    photos, the network of LPIPS; None where there is none."""

    temperature: TemperatureRange | None
    foreground: Foreground | None
    lpips: Lpips | None

    def figures(self, modality: Modality, photo: Pixels | None, rendering: Rendering) -> Figures:
        """The figures of one modality in one view, by ``figure_names``."""
        names = figure_names(modality)
        found = _compared(modality, photo, rendering)
        if isinstance(found, Missing):
            return all_missing(names, found.reason)
        image, photo = found
        compared = photo.values, photo.valid
        figures: Figures = {
            "psnr": psnr(image, *compared),
            "psnr_matched": psnr_matched(image, *compared),
            "ssim": ssim(image, *compared),
            "ssim_pair_range": ssim_pair_range(image, *compared),
            "lpips": _lpips(image, photo, self.lpips),
        }
        if modality == THERMAL:
            figures |= _temperature_figures(image, photo, self.temperature, self.foreground)
        return {name: figures[name] for name in names}


def _compared(
    modality: Modality, photo: Pixels | None, rendering: Rendering
) -> tuple[Tensor, Pixels] | Missing:
    """A modality's rendered image and its photo, or why they cannot be compared."""
    if photo is None or modality not in rendering:
        return Missing(f"the view has no {modality.title} image, or the model does not render it")
    if photo.valid is not None and not photo.valid.any():
        return Missing("no pixel of the photo is valid")
    return rendering[modality].image, photo


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
    """MAE in °C over the frame, the same after the photo's own offset, and over the foreground."""
    if temperature is None:
        return all_missing(CELSIUS_FIGURES, NO_CELSIUS)
    compared, span_c = (image, photo.values, photo.valid), temperature.span_c
    figures: Figures = {
        "mae_c": mean_absolute_error(*compared) * span_c,
        "mae_offset_c": mean_absolute_error_after_offset(*compared) * span_c,
        "mae_foreground_c": Missing("no photo has two classes for Otsu's threshold to part"),
    }
    if foreground is not None:
        mask = foreground.of(photo)
        figures["mae_foreground_c"] = (
            mean_absolute_error(image, photo.values, mask) * span_c
            if mask.any()
            else Missing("no pixel of the photo belongs to the foreground")
        )
    return figures


KNOCK_OUT_FIGURES = ("thermal_psnr", "rgb_psnr", "truth_mae_c")


@dataclass(frozen=True)
class Parts:
    """The parts of a run's model: how much they differ from Gaussian to Gaussian, and mean figures
    of the held-out views for each copy of ``knock_outs``, by the names in ``KNOCK_OUT_FIGURES``."""

    spreads: PartSpreads
    knock_out: Mapping[str, Mapping[str, Figure]]
    temperature: TemperatureRange | None


def score_parts(run: Run, views: Sequence[View], truth: Truth | None = None) -> Parts | None:
    """Knock the parts out of a run's model, one at a time, and score what is left. None for a model
    without the paper's field (3DGS_RGB-T). SceneError if an image or truth cannot be read."""
    spreads = part_spreads(run.model, views[0].camera.position.float())
    if spreads is None:
        return None
    copies = run.with_parts_changed(knock_outs)
    scored: dict[str, list[Figures]] = {part: [] for part in copies}
    for view in views:
        photos = {modality: image.load() for modality, image in view.images.items()}
        for part, copy in copies.items():
            scored[part].append(_score(copy, view, photos, truth))
    means = {part: mean_figures(each, KNOCK_OUT_FIGURES) for part, each in scored.items()}
    return Parts(spreads, means, run.temperature)


def _score(run: Run, view: View, photos: Mapping[Modality, Pixels], truth: Truth | None) -> Figures:
    """One view's figures of a run that lacks a part."""
    rendering = run.render_cameras(
        {each: view.cameras[each] for each in BUILT_IN if each in view.cameras}
    )
    observed = run.camera_response(rendering, view.camera)
    figures: Figures = {
        f"{modality}_psnr": _psnr(modality, photos.get(modality), observed) for modality in BUILT_IN
    }
    thermal = rendering[THERMAL].image if THERMAL in rendering else None
    figures["truth_mae_c"] = (
        Missing("the scene has no exact truth")
        if truth is None
        else truth.score(view.name, thermal, None, None, run.temperature)["mae_c"]
    )
    return figures


def _psnr(modality: Modality, photo: Pixels | None, rendering: Rendering) -> Figure:
    found = _compared(modality, photo, rendering)
    if isinstance(found, Missing):
        return found
    image, photo = found
    return psnr(image, photo.values, photo.valid)
