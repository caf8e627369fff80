"""What a trained model loses when it is baked into plain splats."""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

from mrgs.evaluation.metrics import psnr
from mrgs.runs.baked import BakedModel
from mrgs.runs.open import Run
from mrgs.scene import PosedImage, Scene


class BakingLoss(NamedTuple):
    """Mean over the held-out views of PSNR(photo, trained model) − PSNR(photo, baked model), dB;
    None without photos.

    Negative where the baked model is closer to the photos.
    """

    rgb_db: float | None
    thermal_db: float | None


def baking_loss_db(run: Run, baked: BakedModel, scene: Scene) -> BakingLoss:
    """Render the held-out views with both models and compare them with the photos.

    Raises:
        SceneError: a photo cannot be read.
    """
    rgb, thermal = [], []
    for view in scene.eval:
        camera = view.cameras[0]
        rendering = run.photograph(run.render_view(view), camera)
        if view.rgb is not None and rendering.rgb is not None:
            rgb.append(
                _loss(
                    view.rgb,
                    rendering.rgb,
                    run.photograph(baked.render(view.rgb.camera), camera).rgb,
                )
            )
        if view.thermal is not None and rendering.thermal is not None:
            seen = run.photograph(baked.render(view.thermal.camera), camera)
            thermal.append(_loss(view.thermal, rendering.thermal, seen.thermal))
    return BakingLoss(_mean(rgb), _mean(thermal))


def _loss(photo: PosedImage, trained: Tensor, baked: Tensor | None) -> float:
    assert baked is not None
    pixels = photo.load()
    return psnr(trained, pixels.values, pixels.valid) - psnr(baked, pixels.values, pixels.valid)


def _mean(losses: list[float]) -> float | None:
    """Mean of those that are finite: of identical images, or images without a valid pixel, none
    is."""
    finite = [loss for loss in losses if math.isfinite(loss)]
    return round(math.fsum(finite) / len(finite), 4) if finite else None
