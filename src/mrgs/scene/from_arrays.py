"""Views, start points and the temperature range of a capture that is in memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import zip_longest

import torch
from jaxtyping import Float32
from torch import Tensor

from mrgs.errors import SceneError
from mrgs.scene.arrays import Array, as_tensor
from mrgs.scene.camera import Camera
from mrgs.scene.modality import RGB, THERMAL, Modality
from mrgs.scene.point_cloud import GREY, PointCloud
from mrgs.scene.temperature import TemperatureRange
from mrgs.scene.view import Pixels, PosedImage, View


def range_from_arrays(celsius: Array) -> TemperatureRange | None:
    """The range of the temperatures, rounded outwards to whole degrees; None if there are none.

    Raises:
        SceneError: no temperature is finite.
        ValueError: an array of another shape, or temperatures below absolute zero.
    """
    images = [
        as_tensor(each, None, (None, None), "celsius") for each in celsius if each is not None
    ]
    if not images:
        return None
    finite = [known for image in images if len(known := image[image.isfinite()])]
    if not finite:
        raise SceneError("no thermal image has a finite temperature: give °C")
    low = math.floor(min(known.min().item() for known in finite))
    high = math.ceil(max(known.max().item() for known in finite))
    return TemperatureRange(low, max(high, low + 1))


def views_from_arrays(
    cameras: Sequence[Camera],
    rgb: Array,
    celsius: Array,
    thermal_cameras: Sequence[Camera],
    temperature: TemperatureRange | None,
) -> list[View]:
    """Views of images in memory, named by their number; see ``Scene.from_arrays``.

    Args:
        cameras: of the views, and of their RGB images.
        rgb: of each view, or None; empty if there are none.
        celsius: of each view, or None; empty if there are none.
        thermal_cameras: of the thermal images, one for each view.
        temperature: the scale of the temperatures; None if there are none.

    Raises:
        SceneError: a view has no image.
        ValueError: the numbers of cameras and images differ, or an image does not fit its camera.
    """
    if len(thermal_cameras) != len(cameras):
        raise ValueError(f"{len(cameras)} cameras, but {len(thermal_cameras)} thermal cameras")
    for name, images in (("rgb", rgb), ("celsius", celsius)):
        if len(images) not in (0, len(cameras)):
            raise ValueError(f"{len(cameras)} cameras, but {len(images)} images in {name}")
    views = []
    for number, (camera, colors, thermal_camera, temperatures) in enumerate(
        zip_longest(cameras, rgb, thermal_cameras, celsius)
    ):
        found: dict[Modality, PosedImage] = {}
        if colors is not None:
            found[RGB] = _color_image(camera, colors, f"rgb[{number}]")
        if temperatures is not None and temperature is not None:
            name = f"celsius[{number}]"
            found[THERMAL] = _thermal_image(thermal_camera, temperatures, temperature, name)
        if not found:
            raise SceneError(f"view {number} has no image: leave its camera out")
        views.append(View(f"{number:05d}", found))
    return views


def cloud_from_arrays(points: Array, colors: Array) -> PointCloud | None:
    """Start points without those that are not finite; None if there are none.

    Raises:
        ValueError: an array of another shape.
    """
    if not len(points):
        return None
    positions = as_tensor(points, torch.float32, (None, 3), "points")
    rgb = (
        as_tensor(colors, torch.float32, (len(positions), 3), "colors")
        if len(colors)
        else torch.full_like(positions, GREY)
    )
    finite = positions.isfinite().all(dim=1)
    return PointCloud(positions[finite], rgb[finite]) if finite.any() else None


def _color_image(camera: Camera, colors: Array, name: str) -> PosedImage:
    """An RGB image; bytes are scaled when it is loaded."""
    image = as_tensor(colors, None, (camera.height, camera.width, 3), name)
    scale = 1 / 255 if image.dtype == torch.uint8 else 1.0
    return PosedImage(camera, partial(_load_colors, image, scale))


def _load_colors(image: Tensor, scale: float) -> Pixels:
    return Pixels((image.float() * scale).contiguous())


def _thermal_image(
    camera: Camera, celsius: Array, temperature: TemperatureRange, name: str
) -> PosedImage:
    """A thermal image; °C are normalised when it is loaded."""
    image = as_tensor(celsius, None, (camera.height, camera.width), name)
    return PosedImage(camera, partial(_load_temperatures, image, temperature))


def _load_temperatures(celsius: Tensor, temperature: TemperatureRange) -> Pixels:
    values: Float32[Tensor, "h w 1"] = temperature.from_celsius(celsius.float())[..., None]
    known = celsius.isfinite()
    return Pixels(values) if known.all() else Pixels(values.nan_to_num(0, 0, 0), known)
