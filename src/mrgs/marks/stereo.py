"""Places on a surface by the photos themselves (multi-view stereo).

A model's surfaces are off by some tenths of a per cent of their distance, from every side alike:
what one view has of them is as good as the mean of all. The photos know better. A small patch of
the surface, moved to where all photos that see it show the same in it, is where the object is; what
has no texture stays where the model has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from torch.nn.functional import interpolate

from mrgs.marks.surface import ROBUST_STEPS, SAME_SURFACE, tukey_weights, window_about
from mrgs.scene import RGB, THERMAL, Camera, View, evenly_spaced
from mrgs.scene.depth_map import DepthMap, PhotoSurvey
from mrgs.system.torch_modes import own_modes

Vector: TypeAlias = Float[np.ndarray, "3"]
Samples: TypeAlias = Float[np.ndarray, "v s c"]

PHOTO_WIDTH_PX = 640
"""Wider photos are reduced to this width."""

FEWEST_PHOTOS, MOST_PHOTOS = 3, 16
"""Number of photos that are compared."""

PATCH_PX, PATCH_SAMPLES, PATCH_SIGMA = 8.0, 15, 0.6
"""Half a side of the patch in pixels of the photos, samples along a side, and the standard
deviation of their weights as a share of half a side."""

WINDOW_SHARE = 0.04
"""Half width of what a plane is fitted to, as a share of an image's width."""

LEAST_COSINE = 0.15
"""Photos that see the surface at a more grazing angle do not count."""

DEPTH_DEVIATION, SLOPE_DEVIATION = 0.01, 0.15
"""How far the model's surface is from the object's: its depth as a share of the distance, and its
slope (standard deviations)."""

INDEPENDENT = 0.25
"""Share of the samples that count as independent: neighbours have the same pixels."""

LEAST_NOISE = 0.003
"""Standard deviation of the noise of photos from 0 to 1."""

STEPS = 8
DONE = 1e-4
FARTHEST = 0.05
"""Relative change of depth at which a search ends, and above which it has failed."""


@dataclass(frozen=True, eq=False)
class _Photo:
    """A photo with values from 0 to 1, and its camera as projection from the world to pixels."""

    projection: Float[np.ndarray, "3 4"]
    image: Float[np.ndarray, "h w c"]

    def pixels(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 n"]:
        """Columns and rows of world coordinates, from the centre of the first pixel."""
        x, y, z = self.projection[:, :3] @ points.T + self.projection[:, 3:]
        return np.stack([x, y]) / z - 0.5

    def shows(self, place: Vector) -> bool:
        """Whether a place that its camera sees is in the image."""
        column, row = self.pixels(place[None])[:, 0]
        height, width, _ = self.image.shape
        return bool(0 <= column <= width - 1 and 0 <= row <= height - 1)

    def values(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n c"]:
        """What it shows of points, between pixels linear, [N, C]."""
        height, width, _ = self.image.shape
        column, row = np.clip(self.pixels(points), 0.0, np.array([[width], [height]]) - 1.001)
        left, top = column.astype(np.int64), row.astype(np.int64)
        right, down = (column - left)[:, None], (row - top)[:, None]
        above, below = (
            (1 - right) * self.image[y, left] + right * self.image[y, left + 1]
            for y in (top, top + 1)
        )
        values: Float[np.ndarray, "n c"] = (1 - down) * above + down * below
        return values


class _Patch(NamedTuple):
    """A square of a surface: its samples in the world with weights; how far parameters of 1 move
    them along the normal (until the plane is twice as far from the eye, and two slopes about the
    middle); and the change of the parameters that moves the images by about a third of a pixel."""

    points: Float[np.ndarray, "s 3"]
    weights: Float[np.ndarray, " s"]
    directions: Float[np.ndarray, "3 s 3"]
    pixel: Vector


class PhotoStereo:
    """Finds depths at which photos agree: RGB photos of the ``views`` whose thermal photos are
    surveyed, or without any the thermal ones."""

    def __init__(self, survey: PhotoSurvey, views: Sequence[View]) -> None:
        self._survey = survey
        self._modality = RGB if any(RGB in view.images for view in views) else THERMAL
        self._views = views
        self._photos: dict[int, _Photo] = {}

    @own_modes()
    def depth(self, camera: Camera, x: float, y: float, depth: float) -> float:
        """z-depth of the surface at a place of an image, scene units; that of the model where the
        photos do not give more. SceneError if a photo cannot be read."""
        pixel = torch.tensor([x, y], dtype=torch.float64)
        place = camera.unproject(pixel, pixel.new_tensor(depth)).numpy()
        point = place[None].astype(np.float32)
        seeing = {
            index: item
            for index, item in self._survey.near(point)
            if self._modality in self._views[index].images and len(item.shown(point).rows)
        }
        if len(seeing) < FEWEST_PHOTOS:
            return depth
        normal = _normal(place, list(seeing.values()))
        facing = []
        for index, item in seeing.items():
            towards = item.camera.position.numpy() - place
            if abs(normal @ towards) > LEAST_COSINE * np.linalg.norm(towards):
                facing.append(index)
        chosen = [facing[each] for each in evenly_spaced(len(facing), MOST_PHOTOS)]
        photos = [photo for photo in map(self._photo, chosen) if photo.shows(place)]
        if len(photos) < FEWEST_PHOTOS:
            return depth
        patch = _patch(place, normal, place - camera.position.numpy(), photos)
        step = _step_to_agreement(photos, patch)
        return depth * (1 + step) if abs(step) < FARTHEST else depth

    def _photo(self, index: int) -> _Photo:
        """The photo of a view, kept in half precision."""
        if index not in self._photos:
            image = self._views[index].images[self._modality]
            camera, values = image.camera, image.load().values
            if camera.width > PHOTO_WIDTH_PX:
                camera = camera.with_width(PHOTO_WIDTH_PX)
                size, bands = (camera.height, camera.width), values.permute(2, 0, 1)[None]
                values = interpolate(bands, size, mode="area")[0].permute(1, 2, 0)
            projection = (camera.K @ camera.viewmat[:3]).numpy()
            self._photos[index] = _Photo(projection, values.numpy().astype(np.float16))
        return self._photos[index]


def _normal(place: Vector, maps: Sequence[DepthMap]) -> Vector:
    """Normal of the plane through most of what depth maps show about a place that all see."""
    about = [_about(item, place) for item in maps]
    points, weights = (np.concatenate(each) for each in zip(*about, strict=True))
    now = weights
    for _ in range(ROBUST_STEPS):
        away = points - (now @ points) / now.sum()
        normal: Vector = np.linalg.eigh((away * now[:, None]).T @ away)[1][:, 0]
        left = np.abs(away @ normal)
        now = weights * tukey_weights(left)
    return normal


def _about(
    item: DepthMap, place: Vector
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Points of a depth map about a place, relative to it, and their weights."""
    pixel, distance = item.camera.project(torch.from_numpy(place))
    column, row = (int(each) for each in pixel)
    reach = max(2, round(WINDOW_SHARE * item.camera.width))
    rows, columns = window_about((row, column), reach, item.depth.shape)
    depth = item.depth[np.ix_(rows, columns)].astype(np.float64)
    near = np.abs(depth - distance.item()) < SAME_SURFACE * distance.item()  # false for NaN
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)[near] + 0.5
    found = item.camera.unproject(torch.from_numpy(grid), torch.from_numpy(depth[near])).numpy()
    return found - place, 1 / depth[near] ** 2


def _patch(place: Vector, normal: Vector, sight: Vector, photos: Sequence[_Photo]) -> _Patch:
    """The patch about a place, so large that photos show it on some pixels; ``sight`` is from the
    eye to the place."""
    depths = (each.projection[2] @ [*place, 1.0] for each in photos)
    focals = (np.linalg.norm(each.projection[0, :3]) for each in photos)
    pixel = float(np.median([z / focal for z, focal in zip(depths, focals, strict=True)]))
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    second, half = np.cross(normal, first), PATCH_PX * pixel
    u, v = (each.ravel() for each in np.meshgrid(*[np.linspace(-1, 1, PATCH_SAMPLES)] * 2))
    samples = place + half * (u[:, None] * first + v[:, None] * second)
    weights = np.exp(-(u**2 + v**2) / (2 * PATCH_SIGMA**2))
    directions = np.stack(
        [np.outer(each, normal) for each in (np.full(len(u), normal @ sight), half * u, half * v)]
    )
    steps = np.array([pixel / np.linalg.norm(sight), 1 / PATCH_PX, 1 / PATCH_PX]) / 3
    return _Patch(samples, weights, directions, steps)


def _step_to_agreement(photos: Sequence[_Photo], patch: _Patch) -> float:
    """Share of its distance that the patch moves by to where the photos agree: Gauss-Newton about
    the model's surface. Photos and samples that agree with no others lose their weight."""
    known = np.array([DEPTH_DEVIATION, SLOPE_DEVIATION, SLOPE_DEVIATION])
    now, of_photos, of_samples = np.zeros(3), np.ones(len(photos)), patch.weights
    steps = np.diag(patch.pixel)
    for _ in range(STEPS):
        residuals = _apart(_shown(photos, patch, now), of_photos)
        squares = np.square(residuals).mean(axis=2)
        per_photo = squares @ of_samples / of_samples.sum()
        noise = float(np.median(per_photo)) + LEAST_NOISE**2
        of_photos = 1 / (1 + np.square(per_photo / (2 * noise)))
        per_sample = of_photos @ squares / of_photos.sum()
        of_samples = patch.weights / (
            1 + np.square(per_sample / (3 * np.median(per_sample) + 1e-12))
        )
        ends = [[_shown(photos, patch, now + s) for s in (step, -step)] for step in steps]
        slopes = np.stack(
            [
                _apart((above - below) / (2 * step.sum()), of_photos)
                for (above, below), step in zip(ends, steps, strict=True)
            ]
        )
        weights = np.outer(of_photos, of_samples)[..., None] * (INDEPENDENT / noise)
        information = np.einsum("ivsc,jvsc->ij", slopes * weights, slopes) + np.diag(known**-2)
        pull = np.einsum("ivsc,vsc->i", slopes * weights, residuals) + now / known**2
        change = np.clip(-np.linalg.solve(information, pull), -3 * patch.pixel, 3 * patch.pixel)
        now = now + change
        if abs(change[0]) < DONE:
            break
    return float(now[0])


def _shown(photos: Sequence[_Photo], patch: _Patch, parameters: Vector) -> Samples:
    """What photos show of a moved patch, each without its mean: exposures differ."""
    points = patch.points + np.tensordot(parameters, patch.directions, axes=1)
    values = np.stack([photo.values(points) for photo in photos])
    return values - np.average(values, axis=1, weights=patch.weights)[:, None]


def _apart(values: Samples, weights: Float[np.ndarray, " v"]) -> Samples:
    """Differences to the mean of all photos."""
    return values - np.average(values, axis=0, weights=weights)
