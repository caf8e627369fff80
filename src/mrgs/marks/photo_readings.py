"""What the thermal photos read of a place, beside what the model shows from the same cameras; and
the parts of a temperature's uncertainty that follow from both.

The constants were set on generated scenes with exact temperatures, and checked on others: see
``docs/decisions/068-narrower-uncertainty.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64

from mrgs.data.images import opened, scaling_of
from mrgs.errors import SceneError
from mrgs.marks.surface import seen_depth, thermal_values
from mrgs.scene import THERMAL, CameraResponse, TemperatureRange, View, evenly_spaced
from mrgs.scene.depth_map import DepthMap, DepthMaps, SurfaceRenderer
from mrgs.system.memory import row_chunks

COVERAGE = 2.0
"""Times the standard uncertainty: an interval that contains the truth in 95 of 100 cases."""

OF_ONE_VALUE = COVERAGE / 12**0.5
"""Half the interval for 95 %, in steps: errors within a step are equally likely (GUM F.2.2.1)."""

BLOCK_PX = 8
_TERMS = 50


def rounding_of_mean(variance: float) -> float:
    """Half the width of the interval for 95 of 100 cases that rounding leaves in the mean of many
    values with normal noise of a variance, in steps.

    The error of the mean of rounded values is a Fourier series in the true value; this is twice its
    root mean square."""
    k = np.arange(1, _TERMS)
    squares = np.exp(-4 * np.pi**2 * k**2 * variance) / k**2
    return float(2 * np.sqrt(squares.sum() / 2) / np.pi)


def block_variances(values: Float32[np.ndarray, "h w"]) -> Float[np.ndarray, " b"]:
    """The variances of an image in squares of ``BLOCK_PX`` pixels without NaN."""
    size, (height, width) = BLOCK_PX, values.shape
    rows, columns = height // size, width // size
    blocks = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
    found = blocks.astype(np.float64).var(axis=(1, 3)).ravel()
    return found[np.isfinite(found)]


SHIFT_PX = 3


class Shares(NamedTuple):
    """Weights of the parts.

    Attributes:
        scatter: of the standard deviation of the photos' readings. It is not divided by the root of
            their number: their mean keeps a reflection or a wrong depth.
        blur: of the change by the camera's blur: a peak that the photos show as narrow was higher
            before they blurred it, and their noise makes some.
        deviation: of the difference between a value and the mean of the photos' readings.
    """

    scatter: float
    blur: float
    deviation: float


OF_POINT = Shares(0.85, 0.6, 0.0)
"""Shares for what the photos' cameras see at a single point, which has no deviation."""

OF_MARK = Shares(1.95, 1.0, 1.0)
"""Shares for the mean of a mark."""

FEW_PHOTOS = 2.0
"""The scatter of n photos counts 1 + 2 / (n − 1) times: few may agree by chance."""

ONE_PHOTO = 0.25
"""What one photo alone reads varies by this share of the change of the model's value when the place
is shifted by ``SHIFT_PX``: places and poses are not known better."""

READING, RENDERED = 0, 1
SHIFTS = slice(2, 6)
BLURRED = 6
CHANNELS = 7
"""Channels of a photo: its readings, the model from its camera, the changes of that ``SHIFT_PX`` to
each of four sides and by the camera's blur; in the unit of the values."""


class PhotoParts(NamedTuple):
    """The parts of P places, each half the width of an interval for 95 of 100 cases; NaN where no
    photo looked.

    Attributes:
        photos: their disagreement, and the rounding of their values.
        model: the difference between the value and the photos' readings.
        detail: from how narrow a peak the place is.
    """

    photos: Float[np.ndarray, " p"]
    model: Float[np.ndarray, " p"]
    detail: Float[np.ndarray, " p"]

    @property
    def total(self) -> Float[np.ndarray, " p"]:
        """All together, [P]."""
        return np.hypot(np.hypot(self.photos, self.model), self.detail)


class SightingSums:
    """What photos show of places, gathered photo by photo with weights 1 / z², as temperatures are.
    ``rounding`` is half the interval left by the rounding of the photos' values, in their unit."""

    def __init__(self, places: int, rounding: float = 0.0) -> None:
        self._rounding = rounding
        self.photos = np.zeros(places, np.float32)
        self._weights, self._weights2, self._readings, self._squares = np.zeros(
            (4, places), np.float32
        )
        self._rendered = np.zeros(places, np.float32)
        self._contrast, self._blur = np.zeros((2, places), np.float32)

    def add(
        self,
        rows: Int64[np.ndarray, " m"],
        values: Float32[np.ndarray, "m c"],
        z: Float32[np.ndarray, " m"],
    ) -> None:
        """Add a photo's channels at places, each once, with their z-depths; NaN does not count."""
        known = np.isfinite(values).all(axis=1)
        rows, values, weights = rows[known], values[known], z[known] ** -2.0
        self.photos[rows] += 1
        self._weights[rows] += weights
        self._weights2[rows] += weights**2
        share = weights / self._weights[rows]
        step = values[:, READING] - self._readings[rows]
        self._readings[rows] += share * step
        self._squares[rows] += weights * step * (values[:, READING] - self._readings[rows])
        for mean, new in (
            (self._contrast, np.square(values[:, SHIFTS]).mean(axis=1)),
            (self._blur, values[:, BLURRED]),
            (self._rendered, values[:, RENDERED]),
        ):
            mean[rows] += share * (new - mean[rows])

    @property
    def rendered(self) -> Float32[np.ndarray, " p"]:
        """What the photos' cameras see in the model; NaN where none looks."""
        return np.where(self.photos > 0, self._rendered, np.float32(np.nan))

    @property
    def readings(self) -> Float32[np.ndarray, " p"]:
        """What the photos read, as ``PhotoReadings`` has it; NaN where none looks."""
        return np.where(self.photos > 0, self._readings, np.float32(np.nan))

    def parts(self, shares: Shares, values: Float[np.ndarray, " p"] | None = None) -> PhotoParts:
        """The parts of the uncertainty; ``values`` of the places where their deviation counts."""
        seen = np.where(self.photos > 0, np.float32(1), np.float32(np.nan))
        spread = np.sqrt(np.maximum(self._squares, 0) / (seen * self._weights))
        # One close photo among far ones is nearly alone (the effective number of a weighted mean).
        count = (seen * self._weights) ** 2 / self._weights2.clip(np.finfo(np.float32).tiny)
        few = 1 + FEW_PHOTOS / np.maximum(count - 1, 1)
        alone = ONE_PHOTO * np.sqrt(self._contrast) * np.clip(2 - count, 0, 1)
        scatter = np.hypot(few * spread, alone)
        away = 0.0 if values is None else values - self._readings
        return PhotoParts(
            np.hypot(shares.scatter * scatter, self._rounding),
            seen * shares.deviation * np.abs(away),
            seen * shares.blur * np.abs(self._blur),
        )


WIDTH_PX = 320
"""Wider photos are reduced to this width."""

NOISE_PHOTOS = 4
"""Number of photos whose noise is estimated, where their values are rounded."""

EVEN_SHARE = 0.25
"""Share of a photo's blocks that show even surfaces: elsewhere what the model does not resolve
looks like noise, and noise would average the roundings."""

USUAL_BLUR_PX = 1.4
LEAST_BLURRING = 1e-6
"""Share of the range that a known blur changes somewhere in a photo."""

LEAST_SHARE = 0.5
"""A photo that shows less of a mark does not count."""


class PhotoReadings(DepthMaps):
    """The thermal photos of views, such as of ``Scene.survey_views``, beside their renderings:
    depth and channels, NaN where masked; ``respond`` applies the cameras' response to a rendering.
    SceneError where a photo cannot be read."""

    def __init__(
        self,
        render: SurfaceRenderer,
        respond: CameraResponse,
        views: Sequence[View],
        temperature: TemperatureRange | None,
    ) -> None:
        super().__init__(
            [view.images[THERMAL].camera for view in views],
            lambda number: self.witness(views[number]),
        )
        self._views = views
        self._render = render
        self._respond = respond
        self._span = 1.0 if temperature is None else temperature.span_c
        self._least = 0.0 if temperature is None else temperature.min_c
        self._step = _step_of(self._views, self._span)

    def of_mark(self, points: Float32[np.ndarray, "n 3"], value: float) -> PhotoParts:
        """The parts of the uncertainty of a mark's mean, ``value`` as the photos have it, from
        points on its surface; one place. SceneError if a photo cannot be read."""
        sums = SightingSums(1, self._rounding_of_means)
        for _, item in self.near(points):
            shown = item.shown(points)
            values = item.image[shown.pixels]
            known = np.isfinite(values).all(axis=1)
            if known.sum() >= max(LEAST_SHARE * len(points), 1):
                mean = values[known].mean(axis=0, dtype=np.float64, keepdims=True)
                z = shown.z[known].mean(keepdims=True)
                sums.add(np.array([0]), mean.astype(np.float32), z)
        return sums.parts(OF_MARK, np.array([value]))

    def of_points(self, points: Float32[np.ndarray, "n 3"]) -> PhotoParts:
        """The parts of the uncertainty of what the photos' cameras see at points on surfaces, [N];
        SceneError if a photo cannot be read."""
        found = []
        for rows in row_chunks(len(points)):
            sums = SightingSums(rows.stop - rows.start, OF_ONE_VALUE * self._step)
            for _, item in self.near(points[rows]):
                shown = item.shown(points[rows])
                sums.add(shown.rows, item.image[shown.pixels], shown.z)
            found.append(sums.parts(OF_POINT))
        return PhotoParts(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    @cached_property
    def _rounding_of_means(self) -> float:
        """What rounding leaves in a mean over many pixels, by their noise: what single pixels of
        the photos differ from the model by, in the small blocks in which that is least."""
        if not self._step:
            return 0.0
        found = []
        for index in evenly_spaced(len(self._views), NOISE_PHOTOS):
            item = self[index]
            reduced = self._views[index].images[THERMAL].camera.width / item.camera.width
            noise = item.image[..., READING] - item.image[..., RENDERED]
            found.append(reduced**2 * block_variances(noise / self._step))
        variances = np.concatenate(found)
        with_rounding = float(np.quantile(variances, EVEN_SHARE)) if len(variances) else 0.0
        return self._step * rounding_of_mean(max(with_rounding - 1 / 12, 0.0))

    def witness(self, view: View, width_px: int = WIDTH_PX) -> DepthMap:
        """Depth and channels of any photo, at most ``width_px`` wide."""
        photo = view.images[THERMAL]
        camera = photo.camera.at_most(width_px)
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
        difference = _reduced_photo(view, model.shape) - recorded
        image = np.empty((*model.shape, CHANNELS), np.float32)
        # The photo without the camera's blur and drift, as far as the model knows them.
        image[..., READING] = self._least + self._span * (model + difference)
        image[..., RENDERED] = self._least + self._span * model
        shifted = _shifted(model)
        image[..., SHIFTS] = self._span * shifted
        change = (recorded - offset) / (with_gain - offset) - model
        image[..., BLURRED] = self._span * _blurring(change, shifted)
        return DepthMap(camera, seen_depth(rendering).astype(np.float32), image)


def _reduced_photo(view: View, size: tuple[int, ...]) -> Float[np.ndarray, "h w"]:
    """A view's thermal photo averaged to a size; NaN where any averaged pixel is masked."""
    pixels = view.images[THERMAL].load()
    image = pixels.values[..., 0]
    if pixels.valid is not None:
        image = torch.where(pixels.valid, image, torch.nan)
    if tuple(image.shape) != size:
        image = torch.nn.functional.interpolate(image[None, None], size, mode="area")[0, 0]
    reduced: Float[np.ndarray, "h w"] = image.double().numpy()
    return reduced


def _shifted(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 4"]:
    """Differences to the values ``SHIFT_PX`` below, above, to the right and to the left."""
    wide = np.pad(image, SHIFT_PX, mode="edge")
    middle, twice = slice(SHIFT_PX, -SHIFT_PX), 2 * SHIFT_PX
    sides = [
        wide[twice:, middle], wide[:-twice, middle], wide[middle, twice:], wide[middle, :-twice],
    ]  # fmt: skip
    return np.stack(sides, axis=2) - image[..., None]


def _blurring(
    change: Float[np.ndarray, "h w"], shifted: Float[np.ndarray, "h w 4"]
) -> Float[np.ndarray, "h w"]:
    """Change of the model's image by the camera's blur.

    Where no blur is known, that of a usual one: for small widths σ it is σ² / 2 times the
    Laplacian, which four values in the distance d give as 4 (mean − middle) / d².
    """
    if np.abs(change).max() < LEAST_BLURRING:
        return 2 * (USUAL_BLUR_PX / SHIFT_PX) ** 2 * shifted.mean(axis=2)
    return change


def _step_of(views: Sequence[View], span: float) -> float:
    """The step between values of the photos, from the scale or the bits of the first one's file; 0
    if they are not rounded, or that is not known."""
    files = views[0].images[THERMAL].files if views else ()
    try:
        with opened(files[0]) as image:
            scaling = scaling_of(image)
            bits = {"F": 0, "I": 16, "I;16": 16, "I;16B": 16}.get(image.mode, 8)
    except (IndexError, SceneError):
        return 0.0
    if scaling is not None:
        return abs(scaling[0])
    return span / (2**bits - 1) if bits else 0.0
