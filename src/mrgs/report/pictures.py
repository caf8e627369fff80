"""The report's overview: the views that see the marks, with their names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image

from mrgs.marks.mark import Mark
from mrgs.pictures.drawing import Scale, above_scale
from mrgs.pictures.files import to_array, to_picture
from mrgs.pictures.palette import display_range
from mrgs.pictures.values import in_unit, unit_label
from mrgs.report.plan import LABEL_PX, draw_marks
from mrgs.report.spots import SAME_DEPTH, Renderer
from mrgs.scene import THERMAL, Camera, Rendering, Scene, View, in_order

OVERVIEW_PX = 900
OVERVIEW_CANDIDATES = 24
"""Number of views that are tried for the overview."""

MOST_OVERVIEWS = 3
SCALE_GAP_PX = 10
TAIL_PERCENT = 0.2
"""Percentage of the surfaces' temperatures cut off at each end of a picture's colour scale."""


class Overview(NamedTuple):
    """A view with the marks that it sees.

    Attributes:
        seen: names of the marks.
        pictures: the photo of every modality but thermal, RGB first; then the thermal rendering
            above its scale.
    """

    view: str
    seen: list[str]
    pictures: list[Image.Image]


def overviews(
    scene: Scene, marks: Mapping[str, Mark], render: Renderer, decimal: str = "."
) -> list[Overview]:
    """The views that together see most marks, the one that sees most first; at most
    ``MOST_OVERVIEWS``.

    Args:
        decimal: before the decimals of the scale's numbers.

    Raises:
        SceneError: a photo cannot be read.
    """
    views = [view for view in scene.views if THERMAL in view.images]
    candidates = views[:: -(-len(views) // OVERVIEW_CANDIDATES)] if views else []
    seen = [_seen(view, marks, render) for view in candidates]
    left, chosen = set(marks), []
    for _ in range(MOST_OVERVIEWS):
        best = max(range(len(seen)), key=lambda i: len(left & set(seen[i])), default=None)
        if best is None or not left & set(seen[best]):
            break
        shown = {name: marks[name] for name in seen[best] if name in left}
        chosen.append(_overview(candidates[best], shown, scene, render, decimal))
        left -= set(shown)
    return chosen


def _overview(
    view: View, marks: Mapping[str, Mark], scene: Scene, render: Renderer, decimal: str
) -> Overview:
    pictures = []
    for modality in sorted(in_order(view.images), key=lambda each: each == THERMAL):
        camera = view.images[modality].camera
        if modality == THERMAL:
            picture, scale = _thermal(render(camera), camera, scene, decimal)
        else:
            pixels = to_picture(modality, view.images[modality].load().values, None, "inferno")
            picture = Image.fromarray(pixels)
        size = OVERVIEW_PX, max(1, round(picture.height * OVERVIEW_PX / picture.width))
        picture = picture.resize(size, Image.Resampling.LANCZOS)
        _draw_marks(picture, camera, marks)
        pictures.append(
            picture if modality != THERMAL else above_scale(picture, scale, LABEL_PX, SCALE_GAP_PX)
        )
    return Overview(view.name, list(marks), pictures)


def _thermal(
    rendering: Rendering, camera: Camera, scene: Scene, decimal: str
) -> tuple[Image.Image, Scale]:
    """The thermal image in colours that its surfaces use up; the sky may lie beyond them. And their
    scale."""
    values = in_unit(THERMAL, to_array(rendering[THERMAL].image[..., 0]), scene.temperature)
    surface = scene.reach.without_background(camera, rendering.surface_depth(THERMAL))
    limits = display_range(np.where(np.isfinite(to_array(surface)), values, np.nan), TAIL_PERCENT)
    scale = Scale("inferno", *limits, unit_label(THERMAL, scene.temperature), decimal)
    return Image.fromarray(scale.colorize(values)), scale


def _seen(view: View, marks: Mapping[str, Mark], render: Renderer) -> list[str]:
    """Names of the marks whose middle the view's thermal camera sees: in the image and not
    hidden."""
    camera = view.images[THERMAL].camera
    surface = render(camera).surface_depth(THERMAL)
    seen = []
    for name, mark in marks.items():
        pixel, depth = camera.project(torch.from_numpy(np.mean(mark.points, axis=0)))
        if camera.contains(pixel):
            column, row = pixel.int().tolist()
            if abs(surface[row, column] - depth) <= SAME_DEPTH * depth:  # false for NaN
                seen.append(name)
    return seen


def _draw_marks(image: Image.Image, camera: Camera, marks: Mapping[str, Mark]) -> None:
    """Draw the marks that do not reach behind the camera."""
    zoom = image.width / camera.width
    places = {
        name: zoom * camera.project(torch.tensor(mark.points).double())[0].numpy()
        for name, mark in marks.items()
    }
    shown = {name: corners for name, corners in places.items() if np.isfinite(corners).all()}
    draw_marks(image, marks, shown)
