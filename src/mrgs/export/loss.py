"""The quality that a trained model loses when it is baked into plain splats."""

from __future__ import annotations

import math
from typing import TypeAlias

from torch import Tensor

from mrgs.evaluation.metrics import psnr
from mrgs.runs.baked import BakedModel
from mrgs.runs.open import Run
from mrgs.scene import Modality, PosedImage, Scene

BakingLoss: TypeAlias = dict[Modality, float | None]
"""Mean over the held-out views of PSNR(photo, trained model) − PSNR(photo, baked model) of each
modality, dB; None without photos.

Negative where the baked model is closer to the photos.
"""


def baking_loss_db(run: Run, baked: BakedModel, scene: Scene) -> BakingLoss:
    """PSNR of each modality that baking costs, averaged over the held-out views, dB; None for a
    modality without photos.

    Raises:
        SceneError: a photo cannot be read.
    """
    losses: dict[Modality, list[float]] = {modality: [] for modality in baked.modalities}
    for view in scene.eval:
        cameras = {each: camera for each, camera in view.cameras.items() if each in losses}
        if not cameras:
            continue
        trained, plain = (
            run.camera_response(model.render(cameras), view.camera) for model in (run, baked)
        )
        for modality in cameras:
            images = trained[modality].image, plain[modality].image
            losses[modality].append(_loss(view.images[modality], *images))
    return {modality: _mean(each) for modality, each in losses.items()}


def _loss(photo: PosedImage, trained: Tensor, baked: Tensor) -> float:
    pixels = photo.load()
    return psnr(trained, pixels.values, pixels.valid) - psnr(baked, pixels.values, pixels.valid)


def _mean(losses: list[float]) -> float | None:
    """Mean of those that are finite: of identical images, or images without a valid pixel, none
    is."""
    finite = [loss for loss in losses if math.isfinite(loss)]
    return round(math.fsum(finite) / len(finite), 4) + 0.0 if finite else None  # no -0.0
