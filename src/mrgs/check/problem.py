"""A problem of a scene, and the evidence that the rules judge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from mrgs.scene import Camera, Modality, Scene
from mrgs.scene.modality import in_order
from mrgs.scene.view import evenly_spaced
from mrgs.system.wording import counted, listed

Severity = Literal["error", "warning", "note"]
"""Error: training fails, or the model is wrong. Warning: it is worse. Note: may be intended."""

POINTS, PAIRS = 20_000, 50_000_000
"""Maximum number of start points, and of pairs of a point and a camera, that are inspected."""

_CAMERAS_AT_ONCE = 256


@dataclass(frozen=True)
class Problem:
    """A problem of a scene; ``remedy``, one sentence, says what to do unless the text does."""

    severity: Severity
    text: str
    remedy: str = ""


@dataclass(frozen=True, eq=False)
class ImageStatistics:
    """Statistics of an image's usable pixels; of a colour image, of its luminance.

    Attributes:
        sharpness: share of the contrast in the finest details (``photos.sharpness``).
        low_end: share of the pixels at or below the lower end of the scale.
        high_end: share of the pixels at or above its upper end.
        spread: difference of the 1 % and the 99 % quantile; the scale is [0, 1].
        bits: number of bits that a 16-bit image uses; None if it has 8 bits, or if that is not
            known because it was undistorted or reduced.
        small: [H, W] luminance at the width of a thumbnail, NaN where not valid.
    """

    sharpness: float
    low_end: float
    high_end: float
    spread: float
    brightest: float
    bits: int | None
    digest: bytes
    small: Float32[Tensor, "h w"]
    camera: Camera


@dataclass(frozen=True, eq=False)
class Evidence:
    """A scene, the statistics of the photos that were read, by modality and view, and the message
    of each photo that cannot be read."""

    scene: Scene
    photos: Mapping[Modality, Mapping[str, ImageStatistics]] = field(default_factory=dict)
    unreadable: Sequence[str] = ()

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        """The camera of each view's first image, by the view's name; training views first."""
        return {view.name: view.camera for view in self.scene.views}

    @cached_property
    def points(self) -> Float32[Tensor, "n 3"]:
        """Evenly chosen start points; none if the reader placed them at random."""
        positions = self.scene.points.positions
        if any(note.startswith(NO_POINTS) for note in self.scene.notes):
            return positions[:0]
        return positions[evenly_spaced(len(positions), min(POINTS, PAIRS // len(self.cameras)))]

    @cached_property
    def visible(self) -> Bool[Tensor, "v n"]:
        """Which of ``points`` each of ``cameras`` sees."""
        cameras = [*self.cameras.values()]
        return visible(cameras, torch.stack([camera.viewmat for camera in cameras]), self.points)


NO_POINTS = "There are no start points"
"""Beginning of the reader's note if the start points are random."""


def visible(
    cameras: Sequence[Camera], viewmats: Float[Tensor, "v 4 4"], points: Float32[Tensor, "n 3"]
) -> Bool[Tensor, "v n"]:
    """Which points are in front of a camera and inside its image, if it had this view matrix."""
    rows = []
    for first in range(0, len(cameras), _CAMERAS_AT_ONCE):
        block = slice(first, first + _CAMERAS_AT_ONCE)
        turn, shift = viewmats[block, :3, :3].float(), viewmats[block, :3, 3:].float()
        K = torch.stack([camera.K for camera in cameras[block]]).float()
        sizes = torch.tensor([[camera.width, camera.height] for camera in cameras[block]])
        x, y, depth = (turn @ points.T + shift).unbind(dim=1)
        column = K[:, 0, :1] * x / depth + K[:, 0, 2:]
        row = K[:, 1, 1:2] * y / depth + K[:, 1, 2:]
        inside = (column >= 0) & (column < sizes[:, :1]) & (row >= 0) & (row < sizes[:, 1:])
        rows.append(inside & (depth > 0))
    return torch.cat(rows)


def worst_first(problems: Sequence[Problem]) -> tuple[Problem, ...]:
    """Errors, then warnings, then notes; within each in the given order."""
    order = get_args(Severity)
    return tuple(sorted(problems, key=lambda problem: order.index(problem.severity)))


def cameras_by_modality(scene: Scene) -> dict[Modality, dict[str, Camera]]:
    """The cameras of all images of each modality, by the view's name."""
    found: dict[Modality, dict[str, Camera]] = {}
    for view in scene.views:
        for modality, camera in view.cameras.items():
            found.setdefault(modality, {})[view.name] = camera
    return {modality: found[modality] for modality in in_order(found)}


def views_text(names: Sequence[str]) -> str:
    """Number of views and the names of the first ones, for a sentence."""
    return f"{counted(len(names), 'view')} ({listed(names, 5)})"
