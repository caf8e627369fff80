"""The pictures of each view: its images and their overlay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from PIL import Image
from scipy.ndimage import gaussian_filter
from torch import Tensor

from mrgs.data.undistort import sampled
from mrgs.pictures.drawing import Scale, scale_bar
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.palette import colorize, display_range
from mrgs.prepare.contract import Progress
from mrgs.prepare.page.previews import Preview
from mrgs.prepare.rig.images import STEP_PX, inverse_depth
from mrgs.scene import THERMAL, Camera, Modality, PointCloud

EDGE_COLOR = (0, 240, 255)
_EDGE_LEVELS = 16
_EDGE_BLUR_PX = 1.0
_EDGE_SHARE = 0.12
"""Share of the pixels, the steepest, that are candidates for an edge."""


def thermal_overlay(
    preview: Preview, points: PointCloud, visible: Int64[Tensor, " k"] | None = None
) -> Float32[np.ndarray, "h w"] | None:
    """The thermal image warped onto the grid of the view's first image, the photo; NaN outside of
    the thermal image.

    Each pixel of the photo is unprojected to the surface between the sparse points, and projected
    from there into the thermal image. Occlusions are ignored.

    Args:
        points: start points, in world coordinates.
        visible: indices of those that the photo shows; None if not known.

    Returns:
        [H, W] of the photo's preview; None if the view has no pose, no thermal image or no other.
    """
    photo, thermal = next(iter(preview.images.values()), None), preview.images.get(THERMAL)
    if photo is None or thermal is None or photo is thermal:
        return None
    if photo.camera is None or thermal.camera is None:
        return None
    camera = photo.camera
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    depth = _depth(camera, columns, rows, points, visible)
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
    """``thermal_overlay`` of each view, by its name; without those that have none."""
    found = {}
    for done, view in enumerate(previews):
        report("drawing", done, len(previews))
        found[view.name] = thermal_overlay(view, points, (visible or {}).get(view.name))
    return {name: image for name, image in found.items() if image is not None}


def edge_layer(values: Float32[np.ndarray, "h w"]) -> Image.Image:
    """The steepest edges of an image as thin lines on a transparent palette image."""
    known = np.isfinite(values)
    filled = np.where(known, values, np.median(values[known]) if known.any() else 0.0)
    down, right = np.gradient(gaussian_filter(filled.astype(np.float64), _EDGE_BLUR_PX))
    strength = np.hypot(down, right) * (
        gaussian_filter(known.astype(np.float64), 2.0, mode="nearest") > 0.98
    )
    ridge = _on_ridge(strength, down, right)
    limit = np.quantile(strength, 1 - _EDGE_SHARE)
    top = max(float(strength.max()), 1e-12)
    opacity = np.where(ridge & (strength > limit), 0.35 + 0.65 * np.sqrt(strength / top), 0.0)
    layer = Image.fromarray(np.rint(opacity * (_EDGE_LEVELS - 1)).astype(np.uint8))
    layer.putpalette(bytes(EDGE_COLOR) * _EDGE_LEVELS)
    layer.info["transparency"] = bytes(
        round(255 * level / (_EDGE_LEVELS - 1)) for level in range(_EDGE_LEVELS)
    )
    return layer


def _on_ridge(
    strength: Float[np.ndarray, "h w"],
    down: Float[np.ndarray, "h w"],
    right: Float[np.ndarray, "h w"],
) -> np.ndarray:
    """Where the strength is a maximum among both neighbours across the edge."""
    across_rows = np.abs(down) > np.abs(right)
    padded = np.pad(strength, 1)
    vertical = np.maximum(padded[:-2, 1:-1], padded[2:, 1:-1])
    horizontal = np.maximum(padded[1:-1, :-2], padded[1:-1, 2:])
    return strength >= np.where(across_rows, vertical, horizontal)


def _depth(
    camera: Camera,
    columns: Float[np.ndarray, "h w"],
    rows: Float[np.ndarray, "h w"],
    points: PointCloud,
    visible: Int64[Tensor, " k"] | None,
) -> Float[np.ndarray, "h w"]:
    """Depth of each pixel's surface; the points' median depth where they are too few for one."""
    positions = points.positions.double().numpy()
    found = inverse_depth(positions, camera, None if visible is None else visible.numpy())
    if found is not None:
        return 1 / np.maximum(sampled(found.values, columns, rows, STEP_PX), 1e-9)
    depths = camera.project(points.positions.double())[1]
    ahead = depths[depths > 0]
    return np.full(columns.shape, float(ahead.median()) if len(ahead) else 1.0)


THUMBNAIL_PX, SMALL_THUMBNAIL_PX = 320, 240
LARGE_UP_TO = 60
"""Up to this many pairs the thumbnails are large."""

MOST_SHOWN = 120
"""Largest number of pairs that are shown."""

_BAR_PX = 420


class Card(NamedTuple):
    """One view on the page.

    Attributes:
        name: of the view.
        status: "training" or "held out", or why the view is not in the scene.
        registered: whether it has a pose.
        images: by modality.
        warped: the thermal image warped onto the photo; None without poses.
        edges: its steepest edges; None without poses.
    """

    name: str
    status: str
    registered: bool
    images: dict[Modality, InlineImage]
    warped: InlineImage | None
    edges: InlineImage | None


class PairsSection(NamedTuple):
    """The section ``pairs`` of ``sections.html``.

    Attributes:
        cards: the views that are shown.
        total: number of views.
        has_overlays: whether any card has a warped thermal image.
        legend: what the colours mean.
        bar: scale of the colours; None without thermal images.
    """

    cards: list[Card]
    total: int
    has_overlays: bool
    legend: str
    bar: InlineImage | None


def thumbnail_width(count: int) -> int:
    """The width in pixels at which the images of ``count`` pairs are shown."""
    return THUMBNAIL_PX if count <= LARGE_UP_TO else SMALL_THUMBNAIL_PX


def pairs(
    previews: Sequence[Preview],
    overlays: Mapping[str, Float32[np.ndarray, "h w"]],
    unit: str,
    total: int,
) -> PairsSection:
    """Draw the views that are shown.

    Args:
        overlays: thermal images warped onto the photos, by the view's name.
        unit: of the thermal values; empty where they are relative.
    """
    scale = Scale("inferno", *_common_range(previews), unit)
    return PairsSection(
        [_card(preview, overlays.get(preview.name), scale) for preview in previews],
        total,
        bool(overlays),
        "Temperatures" if unit else "Relative thermal values",
        inline_image(
            scale_bar(scale, _BAR_PX, "horizontal"), "scale of the thermal images", png=True
        )
        if any(THERMAL in preview.images for preview in previews)
        else None,
    )


def _common_range(previews: Sequence[Preview]) -> tuple[float, float]:
    """Limits of the colours of all thermal images."""
    images = [
        preview.images[THERMAL].pixels.ravel()[::7]
        for preview in previews
        if THERMAL in preview.images
    ]
    return display_range(np.concatenate(images)) if images else (0.0, 1.0)


def _card(preview: Preview, overlay: Float32[np.ndarray, "h w"] | None, scale: Scale) -> Card:
    name = preview.name
    return Card(
        name,
        preview.status,
        preview.registered,
        images={
            modality: inline_image(
                _picture(modality, image.pixels, scale),
                f"{modality.title} image {name}",
                quality=78,
            )
            for modality, image in preview.images.items()
        },
        warped=None if overlay is None else inline_image(_colored(overlay, scale), "", quality=72),
        edges=None if overlay is None else inline_image(edge_layer(overlay), "", png=True),
    )


def _picture(modality: Modality, pixels: np.ndarray, scale: Scale) -> Image.Image:
    """Colours as they are, temperatures on the common scale, other intensities in grey."""
    if modality == THERMAL:
        return _colored(pixels, scale)
    if pixels.ndim == 2:
        pixels = np.rint(255 * np.nan_to_num(pixels).clip(0, 1)).astype(np.uint8)
    return Image.fromarray(pixels)


def _colored(values: Float32[np.ndarray, "h w"], scale: Scale) -> Image.Image:
    return Image.fromarray(colorize(values, scale.low, scale.high, scale.palette))
