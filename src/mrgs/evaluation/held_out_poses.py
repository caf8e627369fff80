"""Whether the poses of held-out photos are right, and the photos aligned with the model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.evaluation.metrics import psnr
from mrgs.method.camera_model.pose_error import (
    Alignable,
    PoseAgreement,
    agreement,
    alignables,
    halves_px,
    pose_error,
)
from mrgs.method.camera_model.pose_refinement import as_matrix, effect, motion_axes
from mrgs.runs.open import TrainedRun
from mrgs.scene import View
from mrgs.scene.view import evenly_spaced, moved_cameras, moved_view
from mrgs.training.pose_check import looked_at
from mrgs.training.view_pass import pixel_sizes

MOST_VIEWS = 16
"""Number of held-out views that are inspected for wrong poses."""

FEWEST_VIEWS = 4
"""Least number of views: the halves of fewer may agree by chance."""

MOST_ROUNDS = 4
"""Rounds of alignment, each with a rendering from the pose that the last one found."""

NEAR_PX = 0.02
"""Motion of the photo below which alignment stops."""

FEWEST_POINTS = 16
"""Least number of surface points that a view must show."""

MOST_POINTS = 1000


class HeldOutError(NamedTuple):
    """Distance of typical held-out photos from what the model shows, in the inspected pixels, and
    the size of these in pixels of the photos."""

    found: PoseAgreement
    pixel_size: float

    @property
    def photo_px(self) -> float | None:
        """The distance in pixels of the photos; None if the model is not clear enough."""
        known = self.found.is_right or self.found.is_wrong
        return self.found.agreed_px * self.pixel_size if known else None


def looked_at_first(views: Sequence[View]) -> list[View]:
    """The views that are inspected for wrong poses: all, some of many, or none of too few."""
    if len(views) < FEWEST_VIEWS:
        return []
    return [views[number] for number in evenly_spaced(len(views), MOST_VIEWS)]


def held_out_error(
    run: TrainedRun, views: Sequence[View], on_view: Callable[[], None] = lambda: None
) -> HeldOutError | None:
    """How far off what the model shows held-out photos are; None where it shows a surface in too
    few. SceneError if a photo cannot be read."""
    halves, sizes = [], []
    for view in views:
        photographed = _Photographed(run, view)
        images = photographed.images(torch.eye(4, dtype=torch.float64))
        if (frame := _frame(images)) is not None:
            halves.append(halves_px(images, *frame))
            sizes.append(photographed.pixel_size)
        on_view()
    if len(halves) < FEWEST_VIEWS:
        return None
    first, second = torch.stack(halves, dim=1)
    return HeldOutError(agreement(first, second), sum(sizes) / len(sizes))


def aligned_view(run: TrainedRun, view: View, on_view: Callable[[], None] = lambda: None) -> View:
    """The view with its photos where the model shows what they show; as given where nothing fits
    better. SceneError if a photo cannot be read."""
    photographed = _Photographed(run, view)
    motion = best = torch.eye(4, dtype=torch.float64)
    best_db = -math.inf
    for _ in range(MOST_ROUNDS):
        images = photographed.images(motion)
        if (frame := _frame(images)) is None:
            break
        fits = [psnr(each.rendering, each.photo, each.valid) for each in images if each.seen.any()]
        fit_db = sum(fits) / len(fits)  # of the renderings, mean over the images
        if fit_db > best_db:
            best, best_db = motion, fit_db
        centre, axes_px = frame
        error_px = pose_error(images, centre, axes_px)
        if error_px.norm() < NEAR_PX:
            break
        motion = motion @ as_matrix(axes_px @ error_px, centre)
    on_view()
    return moved_view(view, best)


class _Photographed:
    """A view's photos of the modalities that a model renders, at the inspected size."""

    def __init__(self, run: TrainedRun, view: View) -> None:
        self._run = run
        rendered = {each: view.images[each] for each in view.images if each in run.modalities}
        cameras = {modality: image.camera for modality, image in rendered.items()}
        photos = {modality: image.load() for modality, image in rendered.items()}
        self._cameras, self._photos = looked_at(cameras, photos) if cameras else ({}, {})
        self._sizes = pixel_sizes(cameras, self._cameras)

    @property
    def pixel_size(self) -> float:
        """Side of the inspected pixels, in pixels of the first photo."""
        return next(iter(self._sizes.values()))

    def images(self, motion: Float64[Tensor, "4 4"]) -> list[Alignable]:
        """The photos and the renderings that should look like them."""
        if not self._cameras:
            return []
        cameras = moved_cameras(self._cameras, motion)
        first = next(iter(cameras.values()))
        rendering = self._run.render_cameras(cameras)
        observed = self._run.camera_response(rendering, first, self._sizes)
        return alignables(cameras, self._photos, rendering, observed)


def _frame(
    images: Sequence[Alignable],
) -> tuple[Float64[Tensor, "3"], Float64[Tensor, "6 6"]] | None:
    """What the motion of a view is measured about and along: by the image that shows most; None
    where no surface is seen."""
    if not images:
        return None
    image = max(images, key=lambda each: int(each.seen.sum()))
    camera = image.camera
    points = camera.unproject_image(image.depth.double())[image.seen]
    if len(points) < FEWEST_POINTS:
        return None
    points = points[:: -(-len(points) // MOST_POINTS)]
    return camera.position, motion_axes(effect(camera, points)) / camera.focal_px
