"""The terms of L_total (Eq. 20, Sec. Total Loss)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.method.config import TrainConfig
from mrgs.method.losses.distortion import BEGINS, Distortion
from mrgs.method.losses.photometric import (
    HALF_COVERED,
    LossConfig,
    opaqueness_loss,
    photometric_loss,
)
from mrgs.method.losses.radiation import (
    DepthUncertainty,
    RadiationConfig,
    boltzmann_loss,
    boltzmann_weight,
    normalise_radiation,
    thermal_radiation,
)
from mrgs.method.losses.smoothness import Similarity, similarity_of, smoothness_loss
from mrgs.method.losses.term import LossContext, Term
from mrgs.scene import RGB, THERMAL, Modality


def configured_terms(
    config: TrainConfig, extra: Sequence[Term] = (), modalities: Sequence[Modality] = (RGB, THERMAL)
) -> tuple[Term, ...]:
    """The terms of a training: those of its configuration, with a photometric term of each
    modality, and ``extra``, where one with the name of a configured term takes its place."""
    loss, radiation = config.loss, config.radiation
    terms: list[Term] = [Photometric(modality, loss) for modality in modalities]
    if loss.smooth > 0:
        terms.append(Smoothness(loss))
    if loss.opaque > 0:
        terms.append(Opaqueness(loss.opaque))
    if loss.distortion > 0:
        terms.append(Distortion(loss.distortion, round(BEGINS * config.max_steps)))
    if radiation is not None:
        terms.append(Boltzmann(radiation, config.optimizer.uncertainty))
    named = {term.name: term for term in (*terms, *extra)}
    return tuple(named.values())


def term_values(terms: Sequence[Term], context: LossContext) -> dict[str, Float[Tensor, ""]]:
    """The unweighted value of each term that the view has, by name."""
    values = {term.name: term.value(context) for term in terms}
    return {name: value for name, value in values.items() if value is not None}


class Photometric(Term):
    """L_c, L_t, or the same of another modality: Eq. 17 (L_m), with the modality's name."""

    def __init__(self, modality: Modality, config: LossConfig) -> None:
        self.name = modality.name
        self._modality, self._config = modality, config

    def value(self, context: LossContext) -> Float[Tensor, ""] | None:  # noqa: D102
        photo = context.photos.get(self._modality)
        if photo is None:
            return None
        image = context.observed[self._modality].image
        config, scale = self._config, context.scale
        gain = config.gain(self._modality, scale.thermal_contrast, scale.thermal_noise)
        width = gain * config.huber_width(self._modality, scale.thermal_noise)
        target = photo.values
        if gain != 1:
            image, target = gain * image, gain * target
        return photometric_loss(image, target, photo.valid, config.dssim, width)


class Smoothness(Term):
    """L_smooth, Eq. 18, summed over the modalities."""

    name = "smooth"

    def __init__(self, config: LossConfig) -> None:
        self._config = config

    def weight(self, step: int) -> float:  # noqa: D102
        return self._config.smooth

    def value(self, context: LossContext) -> Float[Tensor, ""] | None:  # noqa: D102
        parts = [self._of(modality, context) for modality in context.photos]
        return torch.stack(parts).sum() if parts else None

    def _of(self, modality: Modality, context: LossContext) -> Float[Tensor, ""]:
        blend, scale = context.rendering[modality], context.scale
        gain = self._config.gain(modality, scale.thermal_contrast, scale.thermal_noise)
        everywhere, alike = self._config.smooth_image(
            modality, scale.thermal_noise, scale.rgb_per_thermal
        )
        similarity: Similarity = (None, None)
        if alike > 0:
            colors = context.colors_by_thermal_camera.image
            similarity = similarity_of(colors, everywhere / (everywhere + alike))
        return smoothness_loss(
            blend.image,
            blend.depth,
            context.photos[modality].valid,
            scale.extent,
            gain * (everywhere + alike),
            self._config,
            similarity,
        )


class Opaqueness(Term):
    """L_opaque, not in the paper; for views that have a thermal photo, where o_t is not o_c."""

    name = "opaque"

    def __init__(self, weight: float) -> None:
        self._weight = weight

    def weight(self, step: int) -> float:  # noqa: D102
        return self._weight

    def value(self, context: LossContext) -> Float[Tensor, ""] | None:  # noqa: D102
        own_opacity = THERMAL in context.gaussians.opacity_logits
        if not own_opacity or THERMAL not in context.cameras:
            return None
        rgb, thermal = context.colors_by_thermal_camera, context.rendering[THERMAL]
        return opaqueness_loss(thermal.alpha, rgb.alpha, thermal.depth, rgb.depth)


class Boltzmann(Term):
    """L_boltz, Eq. 13–16, from the photo's temperatures and the rendered depth; learns ψ."""

    name = "boltzmann"

    def __init__(self, config: RadiationConfig, learning_rate: float) -> None:
        self._config = config
        self.learned = self._uncertainty = DepthUncertainty()
        self.learning_rate = learning_rate

    def weight(self, step: int) -> float:  # noqa: D102
        return boltzmann_weight(step, self._config)

    def value(self, context: LossContext) -> Float[Tensor, ""] | None:  # noqa: D102
        photo, scale = context.photos.get(THERMAL), context.scale
        if photo is None:
            return None
        image, depth, alpha = context.observed[THERMAL]
        # A depth that is mostly background's is that of no surface, and no photo's temperature.
        valid = alpha.detach() >= HALF_COVERED
        if photo.valid is not None:
            valid = valid & photo.valid
        target = photo.values[..., 0]
        radiation = thermal_radiation(target, depth, scale.extent, scale.temperature)
        # u judges the depth and does not shape it: it would grow without end to make u small.
        uncertainty = self._uncertainty(depth.detach(), scale.extent)
        return boltzmann_loss(
            image[..., 0], normalise_radiation(radiation, valid), uncertainty, valid
        )
