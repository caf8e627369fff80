"""What a loss is: the one interface through which training compares a rendering with photos."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean, median
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

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
    evenly_spaced,
)
from mrgs.scene.view import share_camera

INTERPOLATED_PX = 3
"""Pixels of a thermal photo this far apart come from detector pixels of their own."""

NOISE_PHOTOS = 16
"""Largest number of photos from which noise and contrast are read."""

MEDIAN_OF_NORMAL = 0.6745
"""The median of the absolute value of a standard normal variable."""


class SceneScale(NamedTuple):
    """What lengths and temperatures are measured by, and how well the latter are known.

    Attributes:
        temperature: scale of the thermal values; None if the scene has no known °C.
        thermal_noise: standard deviation of the thermal photos' noise, normalised temperature.
        thermal_contrast: of the thermal photos, see ``photo_contrast``, normalised temperature.
        rgb_per_thermal: number of RGB photos per thermal photo; 0 where there are none, so that
            nothing is learned of colours.
    """

    extent: float
    temperature: TemperatureRange | None
    thermal_noise: float = 0.0
    thermal_contrast: float = 1.0
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
        some = [thermal[index].load() for index in evenly_spaced(len(thermal), NOISE_PHOTOS)]
        noise, contrast = photo_noise(some, distance_px), photo_contrast(some)
        return cls(scene.extent, scene.temperature, noise, contrast, len(rgb) / len(thermal))


def photo_noise(photos: Sequence[Pixels], distance_px: int = 1) -> float:
    """Standard deviation of the noise of a pixel, in units of the photos' values; 0 without photos.

    A second difference along the rows and then along the columns removes whatever is locally a
    plane, and has 6 times the standard deviation of independent noise (J. Immerkær, Fast Noise
    Variance Estimation, 1996, where it is between neighbours). Its median over all pixels
    hardly sees edges, which are few. Values in steps, of 8 bits for instance, count as noise of
    about a quarter of a step or more.

    The difference is between pixels at ``distance_px``: cameras with few detector pixels write more
    by interpolation, and neighbours then share the noise of one detector pixel.
    """
    responses = [_second_differences(photo, distance_px).abs() for photo in photos]
    found = torch.cat([torch.empty(0), *(each[each.isfinite()] for each in responses)])
    return found.median().item() / MEDIAN_OF_NORMAL / 6 if len(found) > 0 else 0.0


def photo_contrast(photos: Sequence[Pixels]) -> float:
    """What nine tenths of a photo's valid pixels span, in units of the photos' values, the median
    over the photos; 0 without photos.

    A lamp or a drifting detector widens the scale of the scene, and not this.
    """
    spans = []
    for photo in photos:
        values = photo.values if photo.valid is None else photo.values[photo.valid]
        if values.numel() > 0:
            spans.append(float(np.ptp(np.quantile(values.numpy(), (0.05, 0.95)))))
    return median(spans) if spans else 0.0


def _second_differences(photo: Pixels, distance_px: int) -> Float[Tensor, " n"]:
    """Differences of pixels with their neighbours at a distance in the photo; NaN where invalid."""
    values = photo.values
    if photo.valid is not None:
        values = torch.where(photo.valid[:, :, None], values, torch.nan)
    for axis in (0, 1):
        steps = max(values.shape[axis] - 2 * distance_px, 0)
        before, here, behind = (
            values.narrow(axis, k * distance_px if steps else 0, steps) for k in range(3)
        )
        values = before - 2 * here + behind
    return values.flatten()


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
        cameras: where two coincide, a pixel of the one image is the same pixel of the other.
        dilation: of the Gaussians' projected covariances.
        render: renders the model from other cameras, with gradients; costs a pass each.
    """

    rendering: Rendering
    observed: Rendering
    photos: Mapping[Modality, Pixels]
    cameras: Mapping[Modality, Camera]
    gaussians: Gaussians
    dilation: Dilation
    scale: SceneScale
    render: Callable[[Mapping[Modality, Camera]], Rendering]

    @cached_property
    def colors_by_thermal_camera(self) -> Blend:
        """The RGB blend in the pixels of the thermal image. Where the RGB photo's camera is another
        one, or there is none, it is rendered again, once and without gradient. KeyError if the view
        has no thermal camera."""
        if share_camera(self.cameras, RGB, THERMAL):
            return self.rendering[RGB]
        with torch.no_grad():
            return self.render({RGB: self.cameras[THERMAL]})[RGB]


class Term(ABC):
    """One term of L_total (Eq. 20): a name, a weight λ over the steps, and a value.

    Give an instance to ``train(..., terms=[...])``, or add it to ``configured_terms``. Its value
    is logged as ``loss_NAME``, unweighted.

    Attributes:
        name: unique in a training.
        learned: the term's own parameters, which are trained and saved with the model.
        learning_rate: of ``learned``.
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
        """The unweighted loss of a view; None where the view lacks what it compares."""
