"""What a loss is: the one interface through which training compares a rendering with photos."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mrgs.method.camera_model.photo_noise import photo_noise
from mrgs.rasterizer.contract import Dilation
from mrgs.scene import (
    RGB,
    THERMAL,
    Blend,
    Camera,
    Gaussians,
    Modality,
    Pixels,
    PosedImage,
    Rendering,
    Scene,
    TemperatureRange,
)
from mrgs.scene.view import share_camera

INTERPOLATED_PX = 3
"""Pixels of a thermal photo this far apart come from detector pixels of their own."""


class SceneScale(NamedTuple):
    """What lengths and temperatures are measured by, and how well the latter are known.

    Attributes:
        extent: the scene's extent in scene units.
        temperature: scale of the thermal values; None if the scene has no known °C.
        thermal_noise: standard deviation of the thermal photos' noise, normalised temperature.
        rgb_per_thermal: number of RGB photos per thermal photo; 0 where there are none, so that
            nothing is learned of colours.
    """

    extent: float
    temperature: TemperatureRange | None
    thermal_noise: float = 0.0
    rgb_per_thermal: float = 1.0

    @classmethod
    def of(cls, scene: Scene) -> SceneScale:
        """The scale of a scene and its training photos."""
        rgb, thermal = scene.train_photos(RGB), scene.train_photos(THERMAL)
        if not thermal:
            return cls(scene.extent, scene.temperature)
        # Of photos as fine as the colours', neighbouring pixels may be interpolated from one.
        coarseness = math.sqrt(_pixel_density(rgb) / _pixel_density(thermal)) if rgb else 1.0
        distance_px = max(1, round(INTERPOLATED_PX / max(coarseness, 1.0)))
        noise = photo_noise(thermal, distance_px)
        return cls(scene.extent, scene.temperature, noise, len(rgb) / len(thermal))


def _pixel_density(photos: Sequence[PosedImage]) -> float:
    """Pixels per solid angle about the optical axis, mean over the photos."""
    return fmean((photo.camera.K[0, 0] * photo.camera.K[1, 1]).item() for photo in photos)


@dataclass(frozen=True)
class LossContext:
    """What a loss may look at.

    Attributes:
        rendering: what the model shows from the view's cameras.
        observed: the rendering as the cameras would have recorded it: what photos are compared
            with.
        photos: of the view, by modality.
        cameras: of the photos: where two coincide, a pixel of the one image is the same pixel of
            the other.
        gaussians: of the model.
        dilation: of their projected covariances.
        scale: of the scene.
        render: the model from other cameras than the view's, with gradients; costs a pass each.
    """

    rendering: Rendering
    observed: Rendering
    photos: Mapping[Modality, Pixels]
    cameras: Mapping[Modality, Camera]
    gaussians: Gaussians
    dilation: Dilation
    scale: SceneScale
    render: Callable[[Mapping[Modality, Camera]], Rendering]

    @property
    def shares_pixels(self) -> bool:
        """Whether a pixel of the thermal image is the same pixel of the RGB image."""
        return share_camera(self.cameras, RGB, THERMAL)

    @cached_property
    def colors_by_thermal_camera(self) -> Blend:
        """The RGB blend in the pixels of the thermal image. Where the RGB photo's camera is another
        one, or there is none, it is rendered again, once and without gradient.

        Raises:
            KeyError: the view has no thermal camera.
        """
        if self.shares_pixels:
            return self.rendering[RGB]
        with torch.no_grad():
            return self.render({RGB: self.cameras[THERMAL]})[RGB]


class Term(ABC):
    """One term of L_total (Eq. 20): a name, a weight λ over the steps, and a value.

    Give an instance to ``train(..., terms=[...])``, or add it to ``configured_terms``. Its value
    is logged as ``loss_NAME``, unweighted.

    Attributes:
        name: of the term, unique in a training.
        learned: parameters of the term's own, which are trained and saved with the model; None if
            it has none.
        learning_rate: of these parameters.
        replayable: whether ``value`` depends on nothing but the tensors of its context and
            ``learned``. On a GPU it is then recorded with the rest of a step and not called for
            every view. False for one that counts, draws random numbers on the host, or waits for
            the GPU.
    """

    name: str
    learned: nn.Module | None = None
    learning_rate: float = 1e-3
    replayable: bool = True

    def weight(self, step: int) -> float:
        """λ at a step; 1 by default."""
        return 1.0

    def is_due(self, step: int) -> bool:
        """Whether it is computed at a step; always by default."""
        return True

    @abstractmethod
    def value(self, context: LossContext) -> Float[Tensor, ""] | None:
        """The unweighted loss of a view; None where the view has not what it compares."""
