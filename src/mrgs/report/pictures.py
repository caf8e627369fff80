"""The report's pictures: a view with the spots marked, and a crop of each spot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw

from mrgs.pictures.drawing import INK, Scale, draw_text, text_width
from mrgs.pictures.files import to_array, to_picture
from mrgs.report.spots import Renderer, Spot
from mrgs.scene import THERMAL, Camera, Modality, Rendering, View, in_order

OVERVIEW_PX = 720
OVERVIEW_CANDIDATES = 24
"""Number of views that are tried for the overview."""

LABEL_PX = 18
CROP_PX = 260
CROP_SHARE = 0.4
"""Side of a crop, as a share of the image's shorter side."""

SAME_DEPTH = 0.05
"""A view sees a spot if its rendered depth there differs by less than this share."""

WHITE, BLACK = (255, 255, 255), (0, 0, 0)


class Marked(NamedTuple):
    """Pictures of one view.

    Attributes:
        view: its index.
        pictures: the thermal rendering through the palette, and the photo of every other modality
            that the view has; RGB first.
    """

    view: int
    pictures: dict[Modality, Image.Image]


def overview(
    views: Sequence[View], spots: Mapping[str, Spot], render: Renderer, scale: Scale
) -> Marked:
    """Photos and thermal rendering of the view that sees the most spots, with their names.

    Args:
        views: of the capture; at most ``OVERVIEW_CANDIDATES`` of those with a thermal image are
            tried.
        spots: by the name that marks them.
        render: renders the thermal image of a camera.
        scale: colours of the normalised temperatures 0 to 1.
    """
    thermal_views = [index for index, view in enumerate(views) if THERMAL in view.images]
    step = -(-len(thermal_views) // OVERVIEW_CANDIDATES)
    candidates = thermal_views[::step]
    index, seen = max(
        ((index, _seen(views[index], spots, render)) for index in candidates),
        key=lambda pair: len(pair[1]),
    )
    view = views[index]
    cameras, pictures = view.cameras, {}
    for modality, picture in _pictures(view, render(cameras[THERMAL]), scale).items():
        pictures[modality] = _enlarged(picture, OVERVIEW_PX)
        for name in seen:
            _mark(pictures[modality], cameras[modality], spots[name], name)
    return Marked(index, pictures)


def crops(view: View, spot: Spot, rendering: Rendering, scale: Scale) -> Marked:
    """Crops around a spot from the photos and the thermal rendering of the view that shows it
    best."""
    pictures = {
        modality: _crop(picture, view.images[modality].camera, spot)
        for modality, picture in _pictures(view, rendering, scale).items()
    }
    return Marked(spot.view, pictures)


def photo_value(view: View, spot: Spot) -> float | None:
    """Normalised temperature of the thermal photo at a spot: the mean of 3×3 pixels.

    None where the photo has no valid pixel.
    """
    photo = view.images[THERMAL]
    pixels = photo.load()
    values = to_array(pixels.values[..., 0])
    if pixels.valid is not None:
        values = np.where(pixels.valid.numpy(), values, np.nan)
    column, row = (int(value) for value in _pixel(photo.camera, spot))
    patch = values[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    return float(np.nanmean(patch)) if patch.size and np.isfinite(patch).any() else None


def _seen(view: View, spots: Mapping[str, Spot], render: Renderer) -> list[str]:
    """Names of the spots that the view's thermal camera sees: inside the image and not hidden."""
    camera = view.images[THERMAL].camera
    surface = render(camera).surface_depth(THERMAL)
    seen = []
    for name, spot in spots.items():
        pixel, depth = camera.project(torch.from_numpy(spot.position))
        if camera.contains(pixel):
            column, row = pixel.int().tolist()
            if abs(surface[row, column] - depth) <= SAME_DEPTH * depth:  # false for NaN
                seen.append(name)
    return seen


def _pixel(camera: Camera, spot: Spot) -> tuple[float, float]:
    """Column and row of a spot, which may lie outside the image; NaN behind the camera."""
    column, row = camera.project(torch.from_numpy(spot.position))[0].tolist()
    return column, row


def _pictures(view: View, rendering: Rendering, scale: Scale) -> dict[Modality, Image.Image]:
    """The thermal rendering through the palette, and the view's other photos; RGB first."""
    pictures = {}
    for modality in in_order(view.images):
        if modality == THERMAL:
            values = to_array(rendering[THERMAL].image[..., 0])
            pixels = scale.colorize(scale.low + values * (scale.high - scale.low))
        else:
            photo = view.images[modality].load()
            pixels = to_picture(modality, photo.values, None, scale.palette)
        pictures[modality] = Image.fromarray(pixels)
    return pictures


def _enlarged(image: Image.Image, width: int) -> Image.Image:
    return image.resize(
        (width, max(1, round(image.height * width / image.width))), Image.Resampling.LANCZOS
    )


def _mark(image: Image.Image, camera: Camera, spot: Spot, name: str) -> None:
    """A ring around the spot, and its name beside it."""
    x, y = _pixel(camera, spot)
    if math.isnan(x):
        return
    x, y = x * image.width / camera.width, y * image.height / camera.height
    _ring(image, x, y)
    side = -1 if x > image.width - 60 else 1
    width = text_width(name, LABEL_PX)
    middle = x + side * (20 + width / 2)
    box = [middle - width / 2 - 5, y - 12, middle + width / 2 + 5, y + 12]
    ImageDraw.Draw(image).rectangle(box, fill=INK)
    draw_text(image, (middle, y), name, LABEL_PX, WHITE, anchor="mm")


def _ring(image: Image.Image, x: float, y: float, radius: int = 10) -> None:
    draw = ImageDraw.Draw(image)
    for size, color, width in ((radius + 1, BLACK, 4), (radius, WHITE, 2)):
        draw.ellipse([x - size, y - size, x + size, y + size], outline=color, width=width)


def surroundings(view: View, spot: Spot, rendering: Rendering) -> float:
    """Normalised temperature about a spot: the median of its crop's pixels that show a surface;
    that of the spot where none does."""
    camera = view.images[THERMAL].camera
    left, top, side = _square((camera.width, camera.height), *_pixel(camera, spot))
    part = slice(top, top + side), slice(left, left + side)
    values = to_array(rendering[THERMAL].image[..., 0])[part]
    solid = np.isfinite(to_array(rendering.surface_depth(THERMAL))[part])
    return float(np.median(values[solid])) if solid.any() else spot.value


def _square(size: tuple[int, int], x: float, y: float) -> tuple[int, int, int]:
    """Left, top and side of the crop about a pixel, shifted into the image."""
    side = max(8, round(CROP_SHARE * min(size)))
    left = min(max(round(x - side / 2), 0), size[0] - side)
    top = min(max(round(y - side / 2), 0), size[1] - side)
    return left, top, side


def _crop(image: Image.Image, camera: Camera, spot: Spot) -> Image.Image:
    """A square about the spot, shifted into the image where it would reach beyond, with a ring
    around the spot."""
    x, y = _pixel(camera, spot)
    left, top, side = _square(image.size, x, y)
    crop = image.crop((left, top, left + side, top + side)).resize(
        (CROP_PX, CROP_PX), Image.Resampling.BICUBIC
    )
    _ring(crop, (x - left) * CROP_PX / side, (y - top) * CROP_PX / side)
    return crop
