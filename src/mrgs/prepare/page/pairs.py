"""The pictures of each view: its images and their overlay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32
from PIL import Image

from mrgs.pictures.drawing import Scale, scale_bar
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.palette import colorize, display_range
from mrgs.prepare.page.overlay import edge_layer
from mrgs.prepare.page.previews import Preview
from mrgs.scene import THERMAL, Modality

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
        previews: those that are shown.
        overlays: thermal images warped onto the photos, by the view's name.
        unit: of the thermal values; empty where they are relative.
        total: number of views.
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
