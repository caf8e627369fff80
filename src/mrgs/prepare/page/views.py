"""The pictures of each view: its images, small, and their overlay; and photos to measure in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64, UInt8
from PIL import Image
from scipy.ndimage import gaussian_filter
from torch import Tensor

from mrgs.data.images import DRAFT_MARGIN, decode, with_channels
from mrgs.data.sources import decode_rgb
from mrgs.data.undistort import reduced, sampled
from mrgs.errors import SceneError
from mrgs.pictures.drawing import Scale, scale_bar
from mrgs.pictures.files import to_rgb8
from mrgs.pictures.html import inline_image
from mrgs.pictures.palette import display_range
from mrgs.prepare.contract import ConvertedView, Progress
from mrgs.prepare.rig.images import STEP_PX, inverse_depth
from mrgs.scene import RGB, THERMAL, Camera, Modality, Pixels, PointCloud, TemperatureRange, View
from mrgs.scene.view import evenly_spaced


class PreviewImage(NamedTuple):
    """An image at the size in which the page shows it, and its camera, None without a pose. Three
    channels become 8-bit colours, others their mean: in °C where known, NaN where not valid."""

    pixels: UInt8[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w"]
    camera: Camera | None


class Preview(NamedTuple):
    """A view at the size in which the page shows it: ``status`` is "training" or "held out", or why
    it is not in the scene; ``registered``, whether it has a pose; and the images are by modality,
    RGB first, without those that are missing."""

    name: str
    status: str
    registered: bool
    images: Mapping[Modality, PreviewImage]


def preview_of_pixels(
    view: View,
    status: str,
    temperature: TemperatureRange | None,
    width: int,
    pixels: Mapping[Modality, Pixels],
) -> Preview:
    """Preview of a view with a pose, at most ``width`` pixels wide."""
    images = {
        modality: PreviewImage(
            _shown(modality, found.values, found.valid, temperature, width),
            view.images[modality].camera.at_most(width),
        )
        for modality, found in pixels.items()
    }
    return Preview(view.name, status, True, images)


def preview_of_files(
    scene: Path, view: ConvertedView, status: str, temperature: TemperatureRange | None, width: int
) -> Preview:
    """Preview of a view without a pose, from its files; unreadable images are left out."""
    images = {}
    try:
        for modality, image in view.images.items():
            values, valid, kind = decode(scene / image.file, DRAFT_MARGIN * width)
            own = None if kind == "float" else temperature
            values = with_channels(values, modality.channels)
            images[modality] = PreviewImage(_shown(modality, values, valid, own, width), None)
    except (SceneError, ValueError) as error:
        status = f"{status}; {error}"
    return Preview(view.name, status, False, images)


def _shown(
    modality: Modality,
    values: Float32[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None,
    temperature: TemperatureRange | None,
    width: int,
) -> UInt8[np.ndarray, "y x 3"] | Float32[np.ndarray, "y x"]:
    """Pixels of a ``PreviewImage``."""
    if modality.channels == 3:
        return to_rgb8(reduced(values, None, width)[0])
    values, valid = reduced(values, valid, width)
    shown = values.mean(dim=-1)
    if modality == THERMAL and temperature is not None:
        shown = temperature.to_celsius(shown)
    if valid is not None:
        shown = torch.where(valid, shown, torch.nan)
    return shown.numpy()


EDGE_COLOR = (0, 240, 255)
_EDGE_LEVELS = 16
_EDGE_BLUR_PX = 1.0
_EDGE_SHARE = 0.12
"""Share of the pixels, the steepest, that are candidates for an edge."""


def thermal_overlay(
    preview: Preview, points: PointCloud, visible: Int64[Tensor, " k"] | None = None
) -> Float32[np.ndarray, "h w"] | None:
    """The thermal image warped onto the grid of the view's first image, the photo; NaN outside.
    Each pixel is unprojected to the surface between the sparse points, of which the photo shows the
    ``visible`` ones (None if not known), and projected into the thermal image, without occlusions.
    None for a view without a pose, a thermal image or another one."""
    photo, thermal = next(iter(preview.images.values()), None), preview.images.get(THERMAL)
    if photo is None or thermal is None or photo is thermal:
        return None
    if photo.camera is None or thermal.camera is None:
        return None
    camera = photo.camera
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    positions = points.positions.double()
    found = inverse_depth(positions.numpy(), camera, None if visible is None else visible.numpy())
    if found is not None:
        depth = 1 / np.maximum(sampled(found.values, columns, rows, STEP_PX), 1e-9)
    else:  # too few points for a surface
        depths = camera.project(positions)[1]
        ahead = depths[depths > 0]
        depth = np.full(columns.shape, float(ahead.median()) if len(ahead) else 1.0)
    world = camera.unproject(
        torch.from_numpy(np.stack([columns, rows], axis=-1)), torch.from_numpy(depth)
    )
    pixels, _ = thermal.camera.project(world)
    inside = thermal.camera.contains(pixels).numpy()
    x, y = np.nan_to_num(pixels.numpy()).transpose(2, 0, 1)
    values = sampled(thermal.pixels, np.where(inside, x, 0.0), np.where(inside, y, 0.0))
    return np.where(inside, values, np.nan).astype(np.float32)


def thermal_overlays(
    previews: Sequence[Preview],
    points: PointCloud,
    visible: Mapping[str, Int64[Tensor, " _"]] | None = None,
    report: Progress = lambda step, done, total: None,
) -> dict[str, Float32[np.ndarray, "h w"]]:
    """``thermal_overlay`` of each view, by its name, where there is one."""
    found = {}
    for done, view in enumerate(previews):
        report("drawing", done, len(previews))
        found[view.name] = thermal_overlay(view, points, (visible or {}).get(view.name))
    return {name: image for name, image in found.items() if image is not None}


def edge_layer(values: Float32[np.ndarray, "h w"]) -> Image.Image:
    """The steepest edges of an image as thin lines on a transparent palette image."""
    known = np.isfinite(values)
    filled = np.where(known, values, np.median(values[known]) if known.any() else 0.0)
    blurred = gaussian_filter(filled.astype(np.float64), _EDGE_BLUR_PX)
    down, right = (each[1:-1, 1:-1] for each in np.gradient(np.pad(blurred, 1, mode="edge")))
    strength = np.hypot(down, right) * (
        gaussian_filter(known.astype(np.float64), 2.0, mode="nearest") > 0.98
    )
    padded = np.pad(strength, 1)
    vertical = np.maximum(padded[:-2, 1:-1], padded[2:, 1:-1])
    horizontal = np.maximum(padded[1:-1, :-2], padded[1:-1, 2:])
    ridge = strength >= np.where(np.abs(down) > np.abs(right), vertical, horizontal)
    limit = np.quantile(strength, 1 - _EDGE_SHARE)
    top = max(float(strength.max()), 1e-12)
    opacity = np.where(ridge & (strength > limit), 0.35 + 0.65 * np.sqrt(strength / top), 0.0)
    layer = Image.fromarray(np.rint(opacity * (_EDGE_LEVELS - 1)).astype(np.uint8))
    layer.putpalette(bytes(EDGE_COLOR) * _EDGE_LEVELS)
    layer.info["transparency"] = bytes(
        round(255 * level / (_EDGE_LEVELS - 1)) for level in range(_EDGE_LEVELS)
    )
    return layer


THUMBNAIL_PX, SMALL_THUMBNAIL_PX = 320, 240
LARGE_UP_TO = 60
"""Up to this many pairs the thumbnails are large."""

MOST_SHOWN = 120
"""Largest number of pairs that are shown."""

_BAR_PX = 420


def thumbnail_width(count: int) -> int:
    """The width in pixels at which the images of ``count`` pairs are shown."""
    return THUMBNAIL_PX if count <= LARGE_UP_TO else SMALL_THUMBNAIL_PX


def pairs(
    previews: Sequence[Preview],
    overlays: Mapping[str, Float32[np.ndarray, "h w"]],
    unit: str,
    total: int,
) -> dict[str, Any]:
    """The section ``pairs`` of ``sections.html``: the cards of the views that are shown, with the
    ``overlays`` of ``thermal_overlays``, and the scale of the colours, None without thermal images;
    the ``unit`` of the thermal values is empty where they are relative."""
    thermal = [view.images[THERMAL].pixels for view in previews if THERMAL in view.images]
    limits = (0.0, 1.0)
    if thermal:
        limits = display_range(np.concatenate([each.ravel()[::7] for each in thermal]))
    scale = Scale("inferno", *limits, unit)
    bar = scale_bar(scale, _BAR_PX, "horizontal")
    return {
        "cards": [_card(preview, overlays.get(preview.name), scale) for preview in previews],
        "total": total,
        "has_overlays": bool(overlays),
        "legend": "Temperatures" if unit else "Relative thermal values",
        "bar": inline_image(bar, "scale of the thermal images", png=True) if thermal else None,
    }


def _card(
    preview: Preview, overlay: Float32[np.ndarray, "h w"] | None, scale: Scale
) -> dict[str, Any]:
    """A view on the page: the facts of its preview, its images, the thermal image warped onto the
    photo, and the steepest edges of that; None without poses."""
    images = {
        modality: inline_image(
            _picture(modality, image.pixels, scale),
            f"{modality.title} image {preview.name}",
            quality=78,
        )
        for modality, image in preview.images.items()
    }
    warped = edges = None
    if overlay is not None:
        warped = inline_image(_picture(THERMAL, overlay, scale), "", quality=72)
        edges = inline_image(edge_layer(overlay), "", png=True)
    return {**preview._asdict(), "images": images, "warped": warped, "edges": edges}


def _picture(modality: Modality, pixels: np.ndarray, scale: Scale) -> Image.Image:
    """Colours as they are, temperatures on the common scale, other intensities in grey."""
    if modality == THERMAL:
        pixels = scale.colorize(pixels)
    elif pixels.ndim == 2:
        pixels = np.rint(255 * np.nan_to_num(pixels).clip(0, 1)).astype(np.uint8)
    return Image.fromarray(pixels)


MOST_PHOTOS = 6
MEASURED_PX = 760


def measured_photos(scene: Path, views: Sequence[ConvertedView]) -> list[dict[str, Any]]:
    """Some photos to measure in, of ``views`` that have a pose and an RGB image, evenly
    distributed, with the lens distortion of the file: each view, the file's width and height in
    pixels, and the picture. SceneError if a photo cannot be read."""
    photos = []
    for index in evenly_spaced(len(views), MOST_PHOTOS):
        name, image = views[index].name, views[index].images[RGB]
        values, _ = decode_rgb(scene / image.file, DRAFT_MARGIN * MEASURED_PX)
        shown = Image.fromarray(to_rgb8(reduced(values, None, MEASURED_PX)[0]))
        picture = inline_image(shown, f"photo {name}", quality=75)
        width, height = image.size
        photos.append({"view": name, "width": width, "height": height, "picture": picture})
    return photos
