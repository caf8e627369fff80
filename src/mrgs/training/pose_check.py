"""Whether the photos lie where the model is seen by now; where they do not, their poses are
refined from there on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from mrgs.method.camera_model.pose_error import Alignable, pose_error
from mrgs.method.config import TrainConfig
from mrgs.render import render
from mrgs.scene import THERMAL, Camera, Modality, Pixels
from mrgs.training.resolution import coarser, pixel_sizes
from mrgs.training.state import TrainingState
from mrgs.training.view_pass import PhotographedView, temperature_degree

SHARE_OF_STEPS = 0.1
EARLIEST_STEP = 200
"""By then the model is clear enough to tell, and it still follows poses that move (docs/decisions,
055)."""

SQUARE_PX = 16
"""Side of the squares that the two halves of a photo consist of."""

MOST_PIXELS = 640 * 480
"""Larger photos are looked at in larger pixels."""

MOST_VIEWS = 32
"""So many of the training views tell whether poses are wrong."""

WRONG_PX = 0.3
"""In the pixels that are looked at. Exact poses seem to be off by up to half of this, because the
model is not finished."""


def checked_after(config: TrainConfig, views: int) -> int | None:
    """The step after which poses are checked, with each photo seen once; None if they are not, as
    in a short training or in a block of a scene.

    Args:
        config: of the run.
        views: number of training views.
    """
    image_model = config.image_model
    if not image_model.poses or image_model.poses_rate == 0:
        return None
    share = round(SHARE_OF_STEPS * config.max_steps)
    step = max(EARLIEST_STEP, share, math.ceil(views / config.batch))
    return step if step < config.max_steps else None


def checks_poses_now(state: TrainingState, config: TrainConfig) -> bool:
    """Whether poses are to be checked after the step of the state: when it is due, or as soon as
    possible if that failed."""
    poses = state.image_model.poses
    if poses is None or poses.is_checked:
        return False
    due = checked_after(config, len(poses.motions))
    return due is not None and state.step >= due


def are_wrong(typical_px: float) -> bool:
    """Whether poses that are off by so many pixels are to be refined."""
    return typical_px > WRONG_PX


class PoseCheck:
    """Lays the photos of a training on what its model shows by now.

    Args:
        state: of the training, whose image model may refine poses.
        load: a training view with its photos, by its number.
        config: of the run.
    """

    def __init__(
        self,
        state: TrainingState,
        load: Callable[[int], PhotographedView],
        config: TrainConfig,
    ) -> None:
        assert state.image_model.poses is not None
        self._state, self._load, self._config = state, load, config
        self._poses = state.image_model.poses

    def typical_px(self) -> float:
        """How far a typical photo is off, in the pixels that are looked at.

        What two halves of a photo agree on: an unfinished model differs from the photo in each of
        them in another way, a wrong pose in both alike. A motion of the scene as a whole is left
        out: the model may be too small as yet.
        """
        count = len(self._poses.motions)
        taken = min(count, MOST_VIEWS)
        numbers = [place * count // taken for place in range(taken)]
        found = torch.stack([torch.stack(self._halves_px(number)) for number in numbers], dim=1)
        first, second = (self._poses.apart_from_the_whole(half, numbers) for half in found)
        agreed = (first * second).sum(dim=1)
        return math.sqrt(max(0.0, agreed.median().item()))

    def pixel_size(self) -> float:
        """Side of the pixels that are looked at, in pixels of the first photo."""
        first = self._load(0)
        cameras, _ = self._looked_at(first)
        return next(iter(pixel_sizes(first.view.cameras, cameras).values()))

    def motions(self) -> Float64[Tensor, "v 6"]:
        """What each photo is off, along the axes of its view, for ``PoseRefinement.begin``."""
        found = []
        for number in range(len(self._poses.motions)):
            images = self._seen(number)
            found.append(self._error_px(number, images) / images[0].camera.focal_px)
        return torch.stack(found)

    def _halves_px(self, number: int) -> list[Float64[Tensor, "6"]]:
        """How far a view is off, as either half of it tells."""
        images = self._seen(number)
        return [
            self._error_px(
                number, [each._replace(depth=_half(each.depth, which)) for each in images]
            )
            for which in (0, 1)
        ]

    @torch.no_grad()
    def _seen(self, number: int) -> list[Alignable]:
        """The photos of a training view, with what the model shows."""
        state, each = self._state, self._load(number)
        cameras, photos = self._looked_at(each)
        degrees = {THERMAL: temperature_degree(state, self._config)}
        rendering, _ = render(state.model, cameras, degrees)
        there = torch.full((1,), number, device=state.device)
        observed = state.image_model(rendering, there, pixel_sizes(each.view.cameras, cameras))
        return [
            Alignable(
                camera,
                photos[modality].values,
                photos[modality].valid,
                observed[modality].image,
                rendering.surface_depth(modality),
            )
            for modality, camera in cameras.items()
        ]

    def _looked_at(
        self, each: PhotographedView
    ) -> tuple[Mapping[Modality, Camera], Mapping[Modality, Pixels]]:
        """A view's cameras and photos with the pixels that are trained with, or larger ones."""
        size = self._config.pixel_size_at(self._state.step)
        while max(c.width * c.height for c in each.view.cameras.values()) > MOST_PIXELS * size**2:
            size *= 2
        return coarser(each.view.cameras, each.photos, size)

    def _error_px(self, number: int, images: Sequence[Alignable]) -> Float64[Tensor, "6"]:
        """How far a view is off, along its axes; nothing where it cannot be told."""
        first, axes = images[0].camera, self._poses.axes[number]
        found = pose_error(images, first.position.to(axes), axes / first.focal_px)
        return torch.where(found.isfinite().all(), found, 0)


def _half(depth: Float[Tensor, "h w"], which: int) -> Float[Tensor, "h w"]:
    """The depths in every other square of a chessboard; NaN in the others."""
    row, column = (torch.arange(size, device=depth.device) // SQUARE_PX for size in depth.shape)
    taken = (row[:, None] + column) % 2 == which
    return torch.where(taken, depth, torch.nan)
