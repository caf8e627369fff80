"""What the thermal photos show of a place, beside what the model shows from the same cameras."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Float, Float32
from PIL import Image
from torch import Tensor

from mrgs.marks.surface import SurfaceRenderer, seen_depth, thermal_values
from mrgs.marks.uncertainty.photo_parts import (
    BLURRED,
    CHANNELS,
    OF_MARK,
    OF_POINT,
    READING,
    RENDERED,
    SHIFT_PX,
    SHIFTS,
    PhotoParts,
    SightingSums,
)
from mrgs.marks.uncertainty.rounding import OF_ONE_VALUE, block_variances, of_mean
from mrgs.scene import THERMAL, CameraResponse, TemperatureRange, View, evenly_spaced
from mrgs.scene.depth_map import MAX_VIEWS, DepthMap, visible
from mrgs.system.pieces import pieces

WIDTH_PX = 320
"""Wider photos are reduced to this width."""

NOISE_PHOTOS = 4
"""In which the noise of the values is looked for, where these are rounded."""

EVEN_SHARE = 0.25
"""Of the blocks of a photo, that show even surfaces: elsewhere what the model does not resolve
looks like noise, and noise would average the roundings."""

USUAL_BLUR_PX = 1.4
LEAST_BLURRING = 1e-6
"""Share of the range that a known blur changes somewhere in a photo."""

LEAST_SHARE = 0.5
"""A photo that shows less of a mark does not count."""


class PhotoWitnesses:
    """The thermal training photos with the model rendered from their cameras, each when it is first
    asked for.

    Args:
        render: renders the model with the depth of its surfaces.
        respond: what the cameras make of a rendering.
        views: of the scene; those with a thermal photo count, at most ``MAX_VIEWS``.
        temperature: the scale of the thermal values; None without known °C.
    """

    def __init__(
        self,
        render: SurfaceRenderer,
        respond: CameraResponse,
        views: Sequence[View],
        temperature: TemperatureRange | None,
    ) -> None:
        thermal = [view for view in views if THERMAL in view.images]
        self._views = [thermal[index] for index in evenly_spaced(len(thermal), MAX_VIEWS)]
        self._render = render
        self._respond = respond
        self._span = 1.0 if temperature is None else temperature.span_c
        self._least = 0.0 if temperature is None else temperature.min_c
        self._step = self._span * _step_of(self._views)
        self._maps: dict[int, DepthMap] = {}

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> DepthMap:
        """Depth and channels of one photo; NaN where it is masked.

        Raises:
            SceneError: the photo cannot be read.
        """
        if index not in self._maps:
            self._maps[index] = self._witness(self._views[index])
        return self._maps[index]

    def of_mark(self, points: Float32[np.ndarray, "n 3"], value: float) -> PhotoParts:
        """The parts of the uncertainty of a mark's mean, of one place.

        Args:
            points: on its surface, world coordinates.
            value: its mean, as the photos have it.

        Raises:
            SceneError: a photo cannot be read.
        """
        sums = SightingSums(1, self._rounding_of_means)
        for index, view in enumerate(self._views):
            if not len(visible(view.images[THERMAL].camera, points).rows):
                continue
            item = self[index]
            values = item.image[item.shown(points).pixels]
            values = values[np.isfinite(values).all(axis=1)]
            if len(values) >= max(LEAST_SHARE * len(points), 1):
                sums.add(np.array([0]), _of_mark(values))
        return sums.parts(OF_MARK, np.array([value]))

    def of_points(self, points: Float32[np.ndarray, "n 3"]) -> PhotoParts:
        """The parts of the uncertainty of what the photos' cameras see at N points on surfaces.

        Raises:
            SceneError: a photo cannot be read.
        """
        found = [self._of_piece(points[rows]) for rows in pieces(len(points))]
        return PhotoParts(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    @cached_property
    def _rounding_of_means(self) -> float:
        """What rounding leaves in a mean over many pixels, by their noise: what single pixels of
        the photos differ from the model by, in the small blocks in which that is least."""
        if not self._step:
            return 0.0
        found = []
        for index in evenly_spaced(len(self), NOISE_PHOTOS):
            item = self[index]
            reduced = self._views[index].images[THERMAL].camera.width / item.camera.width
            noise = item.image[..., READING] - item.image[..., RENDERED]
            found.append(reduced**2 * block_variances(noise / self._step))
        variances = np.concatenate(found)
        with_rounding = float(np.quantile(variances, EVEN_SHARE)) if len(variances) else 0.0
        return self._step * of_mean(max(with_rounding - 1 / 12, 0.0))

    def _of_piece(self, points: Float32[np.ndarray, "n 3"]) -> PhotoParts:
        sums = SightingSums(len(points), OF_ONE_VALUE * self._step)
        for index in range(len(self)):
            item = self[index]
            shown = item.shown(points)
            sums.add(shown.rows, item.image[shown.pixels])
        return sums.parts(OF_POINT)

    def _witness(self, view: View) -> DepthMap:
        photo = view.images[THERMAL]
        camera = photo.camera
        if camera.width > WIDTH_PX:
            camera = camera.with_width(WIDTH_PX)
        rendering = self._render(camera)
        record = partial(
            self._respond,
            camera=view.camera,
            pixel_sizes={THERMAL: photo.camera.width / camera.width},
        )
        thermal = rendering[THERMAL].image
        # Constant images separate the photo's gain and offset from its blur.
        even = [rendering.with_images({THERMAL: torch.full_like(thermal, v)}) for v in (0, 1)]
        model = thermal_values(rendering)
        recorded, offset, with_gain = (thermal_values(record(each)) for each in (rendering, *even))
        difference = _reduced(_photo_values(view), model.shape) - recorded
        image = np.empty((*model.shape, CHANNELS), np.float32)
        # The photo without the camera's blur and drift, as far as the model knows them.
        image[..., READING] = self._least + self._span * (model + difference)
        image[..., RENDERED] = self._least + self._span * model
        shifted = _shifted(model)
        image[..., SHIFTS] = self._span * shifted
        change = (recorded - offset) / (with_gain - offset) - model
        image[..., BLURRED] = self._span * _blurring(change, shifted)
        return DepthMap(camera, seen_depth(rendering).astype(np.float32), image)


def _photo_values(view: View) -> Float[Tensor, "h w"]:
    pixels = view.images[THERMAL].load()
    values = pixels.values[..., 0]
    return values if pixels.valid is None else torch.where(pixels.valid, values, torch.nan)


def _reduced(image: Float[Tensor, "h w"], size: tuple[int, ...]) -> Float[np.ndarray, "h2 w2"]:
    """An image averaged to a size; NaN where any of what is averaged is."""
    if tuple(image.shape) != size:
        image = torch.nn.functional.interpolate(image[None, None], size, mode="area")[0, 0]
    reduced: Float[np.ndarray, "h2 w2"] = image.double().numpy()
    return reduced


def _shifted(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 4"]:
    """By how much the values ``SHIFT_PX`` below, above, to the right and to the left are larger."""
    wide = np.pad(image, SHIFT_PX, mode="edge")
    middle, twice = slice(SHIFT_PX, -SHIFT_PX), 2 * SHIFT_PX
    sides = [
        wide[twice:, middle], wide[:-twice, middle], wide[middle, twice:], wide[middle, :-twice],
    ]  # fmt: skip
    return np.stack(sides, axis=2) - image[..., None]


def _blurring(
    change: Float[np.ndarray, "h w"], shifted: Float[np.ndarray, "h w 4"]
) -> Float[np.ndarray, "h w"]:
    """By how much the camera's blur changes what the model shows.

    Where no blur is known, that of a usual one: for small widths σ it is σ² / 2 times the
    Laplacian, which four values in the distance d tell as 4 (mean − middle) / d².
    """
    if np.abs(change).max() < LEAST_BLURRING:
        return 2 * (USUAL_BLUR_PX / SHIFT_PX) ** 2 * shifted.mean(axis=2)
    return change


def _step_of(views: Sequence[View]) -> float:
    """The step between normalised values of the photos, from the bits of the first one's file; 0
    for numbers that are not rounded, and where it cannot be told."""
    files = views[0].images[THERMAL].files if views else ()
    try:
        with Image.open(files[0]) as image:
            bits = {"F": 0, "I": 16, "I;16": 16, "I;16B": 16}.get(image.mode, 8)
    except (IndexError, OSError, ValueError, Image.DecompressionBombError):
        return 0.0
    return 1 / (2**bits - 1) if bits else 0.0


def _of_mark(values: Float32[np.ndarray, "n c"]) -> Float32[np.ndarray, "1 c"]:
    """The mean of a photo's channels over a mark."""
    return values.mean(axis=0, dtype=np.float64, keepdims=True).astype(np.float32)
