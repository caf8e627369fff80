"""The terms of L_total that a view has (Sec. Total Loss), and which images each of them
compares."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.method.config import TrainConfig
from mrgs.method.losses.photometric import (
    LossConfig,
    opaqueness_loss,
    photometric_loss,
)
from mrgs.method.losses.radiation import (
    DepthUncertainty,
    boltzmann_loss,
    boltzmann_weight,
    normalise_radiation,
    thermal_radiation,
)
from mrgs.method.losses.smoothness import smoothness_loss
from mrgs.render import Rendering
from mrgs.scene import Pixels, TemperatureRange

MODALITIES = ("rgb", "thermal")


class Photos(NamedTuple):
    """A view's photos.

    Attributes:
        rgb: None if the view has no colour image.
        thermal: None if it has no thermal image.
        shares_camera: whether one camera took both, so that a pixel of the one is the same pixel of
            the other.
    """

    rgb: Pixels | None
    thermal: Pixels | None
    shares_camera: bool = False


class SceneScale(NamedTuple):
    """What lengths and temperatures are measured by.

    Attributes:
        extent: the scene's extent in scene units.
        temperature: scale of the thermal values; None if the scene has no known °C.
    """

    extent: float
    temperature: TemperatureRange | None


def loss_terms(
    rendering: Rendering,
    photographed: Rendering,
    photos: Photos,
    config: TrainConfig,
    scale: SceneScale,
    uncertainty: DepthUncertainty,
) -> dict[str, Tensor]:
    """L_c, L_t, L_smooth, L_opaque and L_boltz of a view, as far as the view and the method have
    them.

    Args:
        rendering: what the model shows; smoothness is asked of it.
        photographed: the same as its cameras would have written it; the photos are compared with
            it.
        photos: of the view.
        config: of the run.
        scale: of the scene.
        uncertainty: ψ of L_boltz.
    """
    terms: dict[str, Tensor] = {}
    for name in MODALITIES:
        image, photo = getattr(photographed, name), getattr(photos, name)
        if image is not None and photo is not None:
            terms[name] = photometric_loss(image, photo.values, photo.valid, config.loss.dssim)
    if config.loss.smooth > 0:
        terms["smooth"] = torch.stack(
            [_smoothness(rendering, photos, name, config.loss, scale) for name in terms]
        ).sum()
    if config.loss.opaque > 0 and photos.shares_camera:
        terms["opaque"] = _opaqueness(rendering)
    if config.radiation is not None and "thermal" in terms:
        terms["boltzmann"] = _radiation(photographed, photos, scale, uncertainty)
    return terms


def loss_weights(config: TrainConfig, step: int) -> dict[str, float]:
    """λ of each term at a step."""
    weights = {
        "rgb": 1.0,
        "thermal": 1.0,
        "smooth": config.loss.smooth,
        "opaque": config.loss.opaque,
    }
    if config.radiation is not None:
        weights["boltzmann"] = boltzmann_weight(step, config.radiation)
    return weights


def _smoothness(
    rendering: Rendering, photos: Photos, name: str, config: LossConfig, scale: SceneScale
) -> Float[Tensor, ""]:
    """L_smooth of one modality."""
    photo = getattr(photos, name)
    return smoothness_loss(
        getattr(rendering, name),
        getattr(rendering, f"depth_{name}"),
        photo.valid,
        scale.extent,
        getattr(config, f"smooth_{name}"),
        config,
    )


def _opaqueness(rendering: Rendering) -> Float[Tensor, ""]:
    """L_opaque of a rendering by one camera."""
    assert rendering.alpha_thermal is not None
    assert rendering.alpha_rgb is not None
    assert rendering.depth_thermal is not None
    assert rendering.depth_rgb is not None
    return opaqueness_loss(
        rendering.alpha_thermal, rendering.alpha_rgb, rendering.depth_thermal, rendering.depth_rgb
    )


def _radiation(
    photographed: Rendering, photos: Photos, scale: SceneScale, uncertainty: DepthUncertainty
) -> Float[Tensor, ""]:
    """L_boltz from the photo's temperatures and the rendered depth."""
    photo, depth = photos.thermal, photographed.depth_thermal
    assert photo is not None
    assert depth is not None
    assert photographed.thermal is not None
    radiation = thermal_radiation(photo.values[..., 0], depth, scale.extent, scale.temperature)
    radiation = normalise_radiation(radiation, photo.valid)
    return boltzmann_loss(
        photographed.thermal[..., 0], radiation, uncertainty(depth, scale.extent), photo.valid
    )
