"""The images of a view at the size in which the page shows them, and how views are named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

from mrgs.data.images import decode
from mrgs.data.posed import decode_rgb
from mrgs.data.thermal import LUMINANCE
from mrgs.data.undistort import resize
from mrgs.errors import SceneError
from mrgs.pictures.files import to_rgb8
from mrgs.prepare.contract import ConvertedView
from mrgs.scene import Camera, Pixels, TemperatureRange, View


@dataclass(frozen=True, eq=False)
class Preview:
    """A view at the size in which the page shows it.

    Attributes:
        name: the view's.
        status: "training" or "held out", or why the view is not in the scene.
        registered: whether it has a pose.
        rgb: None for a view without a colour image.
        rgb_camera: of ``rgb``; None without a pose.
        thermal: °C, or normalised values where °C are not known; NaN where not valid; None without
            a thermal image.
        thermal_camera: of ``thermal``; None without a pose.
    """

    name: str
    status: str
    registered: bool
    rgb: UInt8[np.ndarray, "h w 3"] | None
    rgb_camera: Camera | None
    thermal: Float32[np.ndarray, "y x"] | None
    thermal_camera: Camera | None


def preview_of_view(
    view: View, status: str, temperature: TemperatureRange | None, width: int
) -> Preview:
    """Preview of a view with a pose, at most ``width`` pixels wide.

    Raises:
        SceneError: an image cannot be read.
    """
    rgb = None if view.rgb is None else view.rgb.load()
    thermal = None if view.thermal is None else view.thermal.load()
    return preview_of_pixels(view, status, temperature, width, rgb, thermal)


def preview_of_pixels(
    view: View,
    status: str,
    temperature: TemperatureRange | None,
    width: int,
    rgb: Pixels | None,
    thermal: Pixels | None,
) -> Preview:
    """Preview of a view whose images have been read; None stands for a missing image."""
    return Preview(
        name=view.name,
        status=status,
        registered=True,
        rgb=None if rgb is None else to_rgb8(_reduced(rgb.values, None, width)[0]),
        rgb_camera=None if rgb is None or view.rgb is None else _camera(view.rgb.camera, width),
        thermal=None
        if thermal is None
        else _temperatures(thermal.values, thermal.valid, temperature, width),
        thermal_camera=None
        if thermal is None or view.thermal is None
        else _camera(view.thermal.camera, width),
    )


def preview_of_files(
    scene: Path, view: ConvertedView, status: str, temperature: TemperatureRange | None, width: int
) -> Preview:
    """Preview of a view without a pose, from its files; unreadable images are left out."""
    rgb = thermal = None
    try:
        if view.rgb is not None:
            values, _ = decode_rgb(scene / view.rgb)
            rgb = to_rgb8(_reduced(values, None, width)[0])
        decoded = decode(scene / view.thermal)
        values = decoded.values if decoded.kind != "colour" else decoded.values @ LUMINANCE[:, None]
        thermal = _temperatures(
            values, decoded.valid, None if decoded.kind == "float" else temperature, width
        )
    except SceneError as error:
        status = f"{status}; {error}"
    return Preview(view.name, status, False, rgb, None, thermal, None)


def views_text(names: Sequence[str], most: int = 5) -> str:
    """How many views, and the first of them by name, in a sentence."""
    shown = ", ".join(names[:most])
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{len(names)} view{'' if len(names) == 1 else 's'} ({shown}{more})"


def _camera(camera: Camera, width: int) -> Camera:
    return camera.with_width(width) if camera.width > width else camera


def _temperatures(
    values: Float32[Tensor, "h w 1"],
    valid: Bool[Tensor, "h w"] | None,
    temperature: TemperatureRange | None,
    width: int,
) -> Float32[np.ndarray, "y x"]:
    """Values in °C where they are known, NaN where they are not valid."""
    values, valid = _reduced(values, valid, width)
    shown = values[..., 0] if temperature is None else temperature.to_celsius(values[..., 0])
    if valid is not None:
        shown = torch.where(valid, shown, torch.nan)
    return shown.numpy()


def _reduced(
    values: Float32[Tensor, "h w c"], valid: Bool[Tensor, "h w"] | None, width: int
) -> tuple[Float32[Tensor, "y x c"], Bool[Tensor, "y x"] | None]:
    height, full_width = values.shape[:2]
    if full_width <= width:
        return values.contiguous(), valid
    return resize(values.contiguous(), valid, width, max(1, round(height * width / full_width)))
