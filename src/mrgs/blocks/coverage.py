"""Which parts of a scene photos show, according to a coarse model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32
from scipy.ndimage import distance_transform_edt, maximum_filter
from torch import Tensor

from mrgs.blocks.region import Region, Ring, ScenePlane
from mrgs.render import Model, render
from mrgs.scene import Camera, Modality, Pixels, PosedImage, Scene, View

ACROSS_PX = 96
"""Width of the images for which the place of each pixel in the scene is computed."""

COUNTED_PX = 32
"""Width of the images by which photos are chosen."""

LEAST_SHARE = 0.1
"""Least share of a photo's pixels that must show a part of the scene to train it."""

SHARE_OF_MOST = 0.5
"""The same as a share of the best photo's, where no photo shows much."""

SKY_PX = 3
"""Width of the sky that counts around a part of a scene, for its outline."""


class Places(NamedTuple):
    """Places in the plane of a scene that the pixels of an image show: coordinates in the plane,
    [H, W, 2]; NaN where the background is seen."""

    known: Float32[np.ndarray, "h w 2"]

    def inside(self, region: Region | Ring) -> Bool[np.ndarray, "h w"]:
        """Which pixels show a region."""
        found: Bool[np.ndarray, "h w"] = region.contains(torch.from_numpy(self.known)).numpy()
        return found

    def counted(self, region: Region | Ring) -> Bool[np.ndarray, "h w"]:
        """Which pixels count for a region: those that show it, and the sky at its outline."""
        inside = self.inside(region)
        sky = np.isnan(self.known[..., 0])
        return inside | (sky & maximum_filter(inside, 2 * SKY_PX + 1))


class Surveyor:
    """Finds the places that cameras show."""

    def __init__(self, model: Model, scene: Scene, plane: ScenePlane) -> None:
        self._model, self._plane, self._reach = model, plane, scene.reach

    @torch.no_grad()
    def places(self, camera: Camera, modality: Modality) -> Places:
        """The places of a small image of a camera. Where the model shows no surface, it is taken to
        be where the nearest pixel shows one."""
        small = camera.with_width(min(ACROSS_PX, camera.width))
        rendering = render(self._model, {modality: small}, with_median_depth=True)[0].cpu()
        depth = rendering.surface_depth(modality)
        if not depth.isfinite().any():
            return Places(np.full((*depth.shape, 2), np.nan, np.float32))
        nearest = distance_transform_edt(
            ~depth.isfinite().numpy(), return_distances=False, return_indices=True
        )
        points = small.unproject_image(depth[tuple(torch.from_numpy(nearest).long())].double())
        places = self._plane.coordinates(points)
        places[self._reach.is_background(points)] = torch.nan
        return Places(places.float().numpy())


def counted_places(surveyor: Surveyor, scene: Scene) -> list[Places]:
    """The places of the training views, in small images."""
    found = []
    for view in scene.train:
        modality = next(iter(view.images))
        known = surveyor.places(view.camera, modality).known
        step = max(1, known.shape[1] // COUNTED_PX)
        found.append(Places(known[::step, ::step].copy()))
    return found


def views_of(region: Region | Ring, places: Sequence[Places]) -> tuple[int, ...]:
    """The views that show a region, by their places."""
    shares = np.array([each.inside(region).mean() for each in places])
    most = shares.max(initial=0.0)
    if most == 0:
        return ()
    return tuple(np.flatnonzero(shares >= min(LEAST_SHARE, SHARE_OF_MOST * most)).tolist())


def only(scene: Scene, region: Region | Ring, views: Sequence[int], surveyor: Surveyor) -> Scene:
    """The same scene and files, but in the photos of these views only pixels that show the region
    count: a run on it is a run on the scene."""
    train = list(scene.train)
    for number in views:
        train[number] = _masked(train[number], region, surveyor)
    return replace(scene, train=tuple(train))


def _masked(view: View, region: Region | Ring, surveyor: Surveyor) -> View:
    images: dict[Modality, PosedImage] = {}
    known: list[tuple[Camera, Bool[np.ndarray, "h w"]]] = []
    for modality, image in view.images.items():
        camera = image.camera
        shared = next((mask for other, mask in known if other.coincides_with(camera)), None)
        mask = surveyor.places(camera, modality).counted(region) if shared is None else shared
        known.append((camera, mask))
        images[modality] = replace(
            image,
            load=partial(_load, image.load, mask),
            load_at_least=partial(_load, image.look, mask),
        )
    return View(view.name, images)


def _load(load: Callable[..., Pixels], mask: Bool[np.ndarray, "h w"], *least_width: int) -> Pixels:
    """An image, or a look at it, of which only the pixels of a smaller mask count."""
    pixels = load(*least_width)
    height, width = pixels.values.shape[:2]
    row, column = (
        torch.arange(size) * small // size
        for size, small in zip((height, width), mask.shape, strict=True)
    )
    counts: Bool[Tensor, "h w"] = torch.from_numpy(mask)[row[:, None], column]
    return Pixels(pixels.values, counts if pixels.valid is None else counts & pixels.valid)
