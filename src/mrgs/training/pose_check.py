"""Whether the photos lie where the model is seen; where not, their poses are refined from then."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.method.camera_model.pose_error import (
    Alignable,
    PoseAgreement,
    agreement,
    alignables,
    halves_px,
    pose_error,
)
from mrgs.method.config import TrainConfig
from mrgs.render import render
from mrgs.scene import THERMAL, Camera, Modality, Pixels
from mrgs.scene.view import evenly_spaced
from mrgs.training.state import TrainingState
from mrgs.training.view_pass import PhotographedView, coarser, pixel_sizes, temperature_degree

SHARE_OF_STEPS = 0.1
EARLIEST_STEP = 200
"""The model is clear enough to tell, and still follows poses that move (docs/decisions, 055)."""

LOOKS = 2
"""Number of times that each photo was trained on by then."""

MOST_PIXELS = 640 * 480
"""Larger photos are inspected in larger pixels."""

MOST_VIEWS = 32
"""Number of training views that are inspected."""


def checked_after(config: TrainConfig, views: int) -> int | None:
    """The step after which poses are checked, with this number of training views; None if they are
    not, as in a short training or in a block of a scene."""
    image_model = config.image_model
    if not image_model.poses or image_model.poses_rate == 0:
        return None
    share = round(SHARE_OF_STEPS * config.max_steps)
    step = max(EARLIEST_STEP, share, math.ceil(LOOKS * views / config.batch))
    return step if step < config.max_steps else None


def checks_poses_now(state: TrainingState, config: TrainConfig) -> bool:
    """Whether poses are to be checked after this step: from when it is due until it succeeds."""
    poses = state.image_model.poses
    if poses is None or poses.is_checked:
        return False
    due = checked_after(config, len(poses.motions))
    return due is not None and state.step >= due


def looked_at(
    cameras: Mapping[Modality, Camera], photos: Mapping[Modality, Pixels], pixel_size: int = 1
) -> tuple[Mapping[Modality, Camera], Mapping[Modality, Pixels]]:
    """A view's cameras and photos as a check of poses inspects them: with pixels of this size, or
    larger ones where there are many."""
    largest = max(camera.width * camera.height for camera in cameras.values())
    while largest > MOST_PIXELS * pixel_size**2:
        pixel_size *= 2
    return coarser(cameras, photos, pixel_size)


class PoseCheck:
    """Compares the photos of a training whose image model may refine poses with what its model
    shows by now; ``load`` gives a training view with its photos, by its number."""

    def __init__(
        self, state: TrainingState, load: Callable[[int], PhotographedView], config: TrainConfig
    ) -> None:
        assert state.image_model.poses is not None
        self._state, self._load, self._config = state, load, config
        self._poses = state.image_model.poses

    def agreement(self) -> PoseAgreement:
        """How far typical photos are off, in the pixels that are inspected, without a motion of the
        scene as a whole: the model may be too small as yet."""
        numbers = evenly_spaced(len(self._poses.motions), MOST_VIEWS)
        halves = []
        for number in numbers:
            images = self._seen(number)
            halves.append(halves_px(images, *self._frame(number, images)))
        found = torch.stack(halves, dim=1)
        return agreement(*(self._poses.without_global_motion(half, numbers) for half in found))

    def pixel_size(self) -> float:
        """Side of the pixels that are inspected, in pixels of the first photo."""
        first = self._load(0)
        cameras, _ = self._looked_at(first)
        return next(iter(pixel_sizes(first.view.cameras, cameras).values()))

    def motions(self) -> Float64[Tensor, "v 6"]:
        """How far each photo is off, along the axes of its view, for ``PoseRefinement.begin``."""
        found = []
        for number in range(len(self._poses.motions)):
            images = self._seen(number)
            error_px = pose_error(images, *self._frame(number, images))
            found.append(error_px / images[0].camera.focal_px)
        return torch.stack(found)

    @torch.no_grad()
    def _seen(self, number: int) -> list[Alignable]:
        """The photos of a training view, with what the model shows."""
        state, each = self._state, self._load(number)
        cameras, photos = self._looked_at(each)
        degrees = {THERMAL: temperature_degree(state, self._config)}
        rendering, _ = render(state.model, cameras, degrees)
        there = torch.full((1,), number, device=state.device)
        observed = state.image_model(rendering, there, pixel_sizes(each.view.cameras, cameras))
        return alignables(cameras, photos, rendering, observed)

    def _looked_at(
        self, each: PhotographedView
    ) -> tuple[Mapping[Modality, Camera], Mapping[Modality, Pixels]]:
        """A view's cameras and photos with the pixels that are trained with, or larger ones."""
        size = self._config.pixel_size_at(self._state.step)
        return looked_at(each.view.cameras, each.photos, size)

    def _frame(
        self, number: int, images: Sequence[Alignable]
    ) -> tuple[Float64[Tensor, "3"], Float64[Tensor, "6 6"]]:
        """What the motion of a view is measured about and along."""
        first, axes = images[0].camera, self._poses.axes[number]
        return first.position.to(axes), axes / first.focal_px
