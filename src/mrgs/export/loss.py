"""What an export costs in quality: PSNR lost by baking, and the error of corrected splats."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from mrgs.evaluation.metrics import psnr
from mrgs.marks.regions import Regions
from mrgs.pictures.files import to_array
from mrgs.runs.baked import BakedModel
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Camera, Modality, Scene, evenly_spaced

BakingLoss: TypeAlias = dict[Modality, float | None]
"""Mean over the held-out views of PSNR(photo, trained model) − PSNR(photo, baked model) of each
modality, dB; None without photos.

Negative where the baked model is closer to the photos.
"""


def baking_loss_db(run: Run, baked: BakedModel, scene: Scene) -> BakingLoss:
    """PSNR of each modality that baking costs, averaged over the held-out views, dB; None for a
    modality without photos. SceneError if a photo cannot be read."""
    losses: dict[Modality, list[float]] = {modality: [] for modality in baked.modalities}
    for view in scene.eval:
        cameras = {each: camera for each, camera in view.cameras.items() if each in losses}
        if not cameras:
            continue
        trained, plain = (
            run.camera_response(model.render(cameras), view.camera) for model in (run, baked)
        )
        for modality in cameras:
            photo = view.images[modality].load()
            of_trained, of_plain = (
                psnr(each[modality].image, photo.values, photo.valid) for each in (trained, plain)
            )
            losses[modality].append(of_trained - of_plain)
    means: BakingLoss = {}
    for modality, each in losses.items():
        # That of identical images, or of images without a valid pixel, is not finite.
        finite = [loss for loss in each if math.isfinite(loss)]
        means[modality] = round(math.fsum(finite) / len(finite), 4) + 0.0 if finite else None
    return means


VIEWS = 16
WIDTH_PX = 320


def correction_note(
    uncorrected: BakedModel, corrected: BakedModel, regions: Regions, cameras: Sequence[Camera]
) -> str:
    """A sentence on how far the blend of splats that were corrected one by one is from the
    correction of the uncorrected blend, in the pixels of the regions in some of the views."""
    note = (
        "Marked surfaces with an emissivity of their own are corrected splat by splat, which is "
        "not exact there and right beside them"
    )
    assert uncorrected.temperature is not None
    span_c, found = uncorrected.temperature.span_c, []
    for index in evenly_spaced(len(cameras), VIEWS):
        camera = cameras[index].with_width(min(cameras[index].width, WIDTH_PX))
        plain = uncorrected.render({THERMAL: camera})
        exact = regions.applied_to(plain, camera)[THERMAL].image
        blended = corrected.render({THERMAL: camera})[THERMAL].image
        own = exact != plain[THERMAL].image
        found.append(to_array(span_c * (blended - exact)[own].abs()))
    errors = np.concatenate(found)
    if not len(errors):
        return f"{note}."
    half, most = np.percentile(errors, [50, 95])
    return f"{note}: half of their pixels are off by up to {half:.1f} °C, 95 % by up to {most:.1f}."
