"""The pictures of a mark: the thermal rendering with its scale, and the photo, both about it."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image

from mrgs.marks import MarkReading
from mrgs.marks.mark import Mark
from mrgs.marks.regions import Regions
from mrgs.pictures.drawing import (
    COLDEST,
    HOTTEST,
    PAPER,
    Scale,
    above_scale,
    cross,
    draw_dot,
    draw_plate,
    draw_strokes,
    text_width,
)
from mrgs.pictures.files import to_array, to_picture
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.palette import display_range
from mrgs.pictures.values import in_unit, unit_label
from mrgs.report.overlays import STROKE_PX
from mrgs.scene import RGB, THERMAL, Camera, Scene, View

WIDTH_PX = 640
MARK_SHARE = 0.5
"""Share of a picture's side that a mark takes up at most."""

LEAST_SHARE = 0.4
"""Of the photo's width that a picture shows at least: what lies about a mark tells where it is."""

SPANNED_SHARE = 0.6
"""Of a picture's sides about the mark whose temperatures the colours span."""

LABEL_PX, BAR_TEXT_PX, SCALE_GAP_PX = 22, 24, 8
CROSS_PX, DOT_PX = 16, 7


def nearest_view(mark: Mark, scene: Scene) -> View | None:
    """The thermal view from nearest to where the mark was drawn that has all of it in its image."""
    points, eye = torch.tensor(mark.points).double(), torch.tensor(mark.eye).double()
    views = [view for view in scene.views if THERMAL in view.images]
    seen = [
        view
        for view in views
        if bool(view.images[THERMAL].camera.contains(_project(view, points)).all())
    ]
    distance = [(view.images[THERMAL].camera.position - eye).norm().item() for view in seen]
    return seen[int(np.argmin(distance))] if seen else None


def _project(view: View, points: torch.Tensor) -> torch.Tensor:
    return view.images[THERMAL].camera.project(points)[0]


def mark_pictures(
    reading: MarkReading, view: View, regions: Regions, scene: Scene, decimal: str = "."
) -> list[InlineImage]:
    """The thermal rendering of a view with its scale, and its photo. ``decimal`` is written before
    the decimals of the scale's numbers.

    Raises:
        SceneError: the photo cannot be read.
    """
    name = reading.mark.name
    camera = _about(reading.mark, view.images[THERMAL].camera)
    values = to_array(regions.render(camera)[THERMAL].image[..., 0])
    values = in_unit(THERMAL, values, scene.temperature)
    limits = display_range(values[_part_about(reading.mark, camera)])
    scale = Scale("inferno", *limits, unit_label(THERMAL, scene.temperature), decimal)
    thermal = Image.fromarray(scale.colorize(values))
    _draw(thermal, reading, camera)
    whole = above_scale(thermal, scale, BAR_TEXT_PX, SCALE_GAP_PX)
    pictures = [inline_image(whole, f"{name}, thermal", quality=90)]
    if RGB in view.images:
        photo_camera = _about(reading.mark, view.images[RGB].camera)
        photo = _cropped(view, photo_camera)
        _draw(photo, reading, photo_camera)
        pictures.append(inline_image(photo, f"{name}, photo", quality=88))
    return pictures


def _about(mark: Mark, camera: Camera) -> Camera:
    """The part of a camera's image about a mark, ``WIDTH_PX`` wide and in the image's proportions;
    never more than the image."""
    pixels, _ = camera.project(torch.tensor(mark.points).double())
    low, high = pixels.min(dim=0).values, pixels.max(dim=0).values
    size = pixels.new_tensor([camera.width, camera.height])
    share = min(max(((high - low) / size).max().item() / MARK_SHARE, LEAST_SHARE), 1.0)
    left, top = (
        min(max(middle - 0.5 * share * whole, 0.0), (1 - share) * whole)
        for middle, whole in zip((0.5 * (low + high)).tolist(), size.tolist(), strict=True)
    )
    zoom = WIDTH_PX / (share * camera.width)
    K = camera.K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    K[:2] *= zoom
    return Camera(K, camera.viewmat, WIDTH_PX, round(zoom * share * camera.height))


def _part_about(mark: Mark, camera: Camera) -> tuple[slice, slice]:
    """The rows and columns about a mark whose temperatures the colours of its picture span: sky and
    ground in a corner would leave none for a wall."""
    pixels, _ = camera.project(torch.tensor(mark.points).double())
    low, high = pixels.min(dim=0).values, pixels.max(dim=0).values
    size = pixels.new_tensor([camera.width, camera.height])
    margin = torch.clamp(0.5 * (SPANNED_SHARE * size - (high - low)), min=0)
    first, last = (low - margin).clamp(min=0).int(), (high + margin).ceil().int()
    return slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))


def _cropped(view: View, wanted: Camera) -> Image.Image:
    """The part of a view's photo that another camera at its place shows."""
    photo = view.images[RGB]
    whole = Image.fromarray(to_picture(RGB, photo.load().values, None, "grey"))
    zoom = wanted.K[0, 0].item() / photo.camera.K[0, 0].item()
    left, top = (photo.camera.K[:2, 2] - wanted.K[:2, 2] / zoom).tolist()
    right, bottom = left + wanted.width / zoom, top + wanted.height / zoom
    return whole.transform(
        (wanted.width, wanted.height),
        Image.Transform.EXTENT,
        (left, top, right, bottom),
        Image.Resampling.BICUBIC,
        fillcolor=PAPER,
    )


def _draw(image: Image.Image, reading: MarkReading, camera: Camera) -> None:
    """The mark with its name and extremes over a picture of a camera."""
    mark = reading.mark
    pixels, _ = camera.project(torch.tensor(mark.points).double())
    corners = [(x, y) for x, y in pixels.tolist()]
    x, y = min(corners, key=lambda corner: corner[1])
    if mark.kind == "spot":
        draw_strokes(image, cross(x, y, CROSS_PX), STROKE_PX)
    else:
        draw_strokes(image, [[*corners, corners[0]] if mark.is_area else corners], STROKE_PX)
        for place, color in ((reading.low_at, COLDEST), (reading.high_at, HOTTEST)):
            if place:
                pixel = camera.project(torch.tensor(place).double())[0]
                draw_dot(image, pixel.tolist(), DOT_PX, color)
    wide = text_width(mark.name, LABEL_PX) + 14
    left = min(max(x + 10, 2), image.width - wide - 2)
    top = min(max(y - LABEL_PX - 22, 2), image.height - LABEL_PX - 12)
    draw_plate(image, (left, top, left + wide, top + LABEL_PX + 10), mark.name, LABEL_PX)
