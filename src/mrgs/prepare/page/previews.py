"""Previews: the images of a view at the size in which the page shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from PIL import Image
from torch import Tensor

from mrgs.data.images import DRAFT_MARGIN, decode, probe, with_channels
from mrgs.data.posed import decode_rgb
from mrgs.data.undistort import reduced
from mrgs.errors import SceneError
from mrgs.pictures.files import to_rgb8
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.prepare.contract import ConvertedView
from mrgs.scene import RGB, THERMAL, Camera, Modality, Pixels, TemperatureRange, View
from mrgs.scene.view import evenly_spaced


@dataclass(frozen=True, eq=False)
class PreviewImage:
    """An image at the size in which the page shows it.

    Attributes:
        pixels: 8-bit colours of an image of three channels. Of others the mean of the channels, in
            °C where these are known, NaN where not valid.
        camera: None without a pose.
    """

    pixels: UInt8[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w"]
    camera: Camera | None


@dataclass(frozen=True, eq=False)
class Preview:
    """A view at the size in which the page shows it.

    Attributes:
        name: the view's.
        status: "training" or "held out", or why the view is not in the scene.
        registered: whether it has a pose.
        images: by modality, RGB first; without those that are missing.
    """

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
    """Preview of a view with a pose, at most ``width`` pixels wide, from the images that were
    read."""
    images = {
        modality: PreviewImage(
            _shown(modality, found.values, found.valid, temperature, width),
            _no_wider(view.images[modality].camera, width),
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


def _no_wider(camera: Camera, width: int) -> Camera:
    return camera.with_width(width) if camera.width > width else camera


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


MOST_PHOTOS = 6
WIDTH_PX = 760


class MeasuredPhoto(NamedTuple):
    """A photo to measure in.

    Attributes:
        view: name of its view.
        width: of the file, in pixels.
        height: of the file, in pixels.
        picture: the photo as shown on the page.
    """

    view: str
    width: int
    height: int
    picture: InlineImage


def measured_photos(scene: Path, views: Sequence[ConvertedView]) -> list[MeasuredPhoto]:
    """Some of the photos, evenly distributed, with the lens distortion of the file.

    Args:
        views: those with a pose and an RGB image.

    Raises:
        SceneError: a photo cannot be read.
    """
    return [_photo(scene, views[index]) for index in evenly_spaced(len(views), MOST_PHOTOS)]


def _photo(scene: Path, view: ConvertedView) -> MeasuredPhoto:
    file = scene / view.images[RGB].file
    values, _ = decode_rgb(file, DRAFT_MARGIN * WIDTH_PX)
    info = probe(file)
    image = Image.fromarray(to_rgb8(reduced(values, None, WIDTH_PX)[0]))
    return MeasuredPhoto(
        view.name, info.width, info.height, inline_image(image, f"photo {view.name}", quality=75)
    )
