"""What a pane is painted from: images and a depth on one pixel grid, from the model or from a
photo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mrgs.marks.regions import Regions
from mrgs.pictures.files import shown_values, to_array, to_rgb8
from mrgs.render import Model, render
from mrgs.scene import Camera, Modality, PosedImage, TemperatureRange
from mrgs.viewer.settings import Subject

ShownImage: TypeAlias = UInt8[np.ndarray, "h w 3"] | Float[np.ndarray, "h w"]
"""Colours, or the values of a one-channel modality in its unit."""


@dataclass(frozen=True, eq=False)
class PaneImages:
    """Images of one pane, all of the same size.

    Attributes:
        images: colours [h, w, 3], or values in their unit [h, w], of each modality; or the
            difference of values to the photo. NaN where the photo is masked.
        depth: z-depth in scene units, blended and divided by alpha, [h, w]; NaN where the model is
            empty. None for a photo.
        solid: where the model, or the photo, shows something, [h, w].
    """

    images: Mapping[Modality, ShownImage]
    depth: Float[np.ndarray, "h w"] | None
    solid: Bool[np.ndarray, "h w"]


def render_pane(
    model: Model,
    camera: Camera,
    subject: Subject,
    as_photo_of: Camera | None = None,
    regions: Regions | None = None,
) -> PaneImages:
    """Render the modalities that the viewer shows.

    Args:
        model: to render.
        camera: of the pane, at the size to render.
        subject: provides the shown modalities and the temperature range.
        as_photo_of: the first camera of a captured view, to show what its cameras would have
            recorded; None to show the model itself.
        regions: surfaces with an emissivity of their own; None shows what the photos have.
    """
    with torch.no_grad():
        cameras = subject.cameras(camera)
        rendering, _ = render(model, cameras, with_median_depth=bool(regions))
    depth = to_array(rendering.visible_depth())
    if as_photo_of is not None:
        rendering = subject.camera_response(rendering, as_photo_of)
    if regions is not None:
        rendering = regions.applied_to(rendering, camera)
    images = {
        modality: shown_image(modality, blend.image, subject.temperature)
        for modality, blend in rendering.items()
    }
    return PaneImages(images, depth, np.isfinite(depth))


def shown_image(
    modality: Modality, image: Float[Tensor, "h w c"], temperature: TemperatureRange | None
) -> ShownImage:
    """A modality's image [H, W, C] as colours [H, W, 3]; of one channel, as values in its unit
    [H, W]."""
    if modality.channels == 1:
        return shown_values(modality, image, temperature)
    return to_rgb8(image)


def photo_images(
    modality: Modality, photo: PosedImage, temperature: TemperatureRange | None
) -> PaneImages:
    """A photo as the images of a pane, at the photo's own size.

    Raises:
        SceneError: it cannot be read.
    """
    pixels = photo.load()
    height, width = pixels.values.shape[:2]
    solid = np.ones((height, width), dtype=bool) if pixels.valid is None else pixels.valid.numpy()
    image = shown_image(modality, pixels.values, temperature)
    if modality.channels == 1:
        image = np.where(solid, image, np.nan).astype(np.float32)
    return PaneImages({modality: image}, None, solid)


def difference(modality: Modality, rendered: PaneImages, photo: PaneImages) -> PaneImages:
    """Rendered minus measured values of a one-channel modality; NaN where the photo is masked or
    the model empty."""
    solid = rendered.solid & photo.solid
    values = np.where(solid, rendered.images[modality] - photo.images[modality], np.nan)
    return PaneImages({modality: values.astype(np.float32)}, rendered.depth, solid)
