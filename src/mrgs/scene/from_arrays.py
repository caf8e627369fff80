"""Views, start points and the temperature range of a capture that is in memory."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from itertools import zip_longest
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from mrgs.errors import SceneError, warn_user
from mrgs.scene.arrays import Array, as_tensor
from mrgs.scene.camera import Camera
from mrgs.scene.modality import RGB, THERMAL, Modality
from mrgs.scene.point_cloud import GREY, PointCloud
from mrgs.scene.radiometry import (
    COLDEST_C,
    HOTTEST_C,
    ZERO_CELSIUS_K,
    TemperatureRange,
    are_everyday,
)
from mrgs.scene.view import Pixels, PosedImage, View

Images: TypeAlias = Iterable[Array | None]
"""One image for each view, None where a view has none."""

_ROUNDING = 1e-3
"""Colours this far outside [0, 1] count as rounded."""

_SAMPLED = 1_000
"""Of each image, about so many temperatures tell whether they are in kelvin."""


def cameras_from(cameras: Iterable[Camera] | None, name: str) -> list[Camera]:
    """Cameras of a caller; empty for None.

    Raises:
        ValueError: something that is no camera.
    """
    listed = _listed(cameras, name, "cameras")
    for number, each in enumerate(listed):
        if not isinstance(each, Camera):
            raise ValueError(
                f"{name}[{number}] is of type {type(each).__name__}, not Camera: make it with "
                f"Camera(K, world_to_camera, width, height)"
            )
    return listed


def color_images(rgb: Images | None) -> list[Tensor | None]:
    """RGB images of a caller: uint8, or numbers in [0, 1] with NaN in pixels that are not known;
    None for those without a known pixel.

    Raises:
        ValueError: no images of three channels, or values in another range.
    """
    images = []
    for number, each in enumerate(_listed(rgb, "rgb", "images")):
        image = None if each is None else _colors(each, (None, None, 3), f"rgb[{number}]")
        images.append(image if image is not None and image.isfinite().any() else None)
    return images


def thermal_images(celsius: Images | None) -> list[Tensor | None]:
    """Thermal images of a caller in °C, NaN where a pixel is not known; None for those without a
    known pixel.

    Raises:
        SceneError: images, but no temperature that is finite.
        ValueError: no images of one channel, or what no camera can have measured.
    """
    images = []
    for number, each in enumerate(given := _listed(celsius, "celsius", "images")):
        image = None if each is None else as_tensor(each, None, (None, None), f"celsius[{number}]")
        images.append(None if image is None else _measured(image, f"celsius[{number}]"))
    if any(each is not None for each in given) and all(image is None for image in images):
        raise SceneError("no thermal image has a finite temperature: give °C")
    return images


def range_of(thermal: Sequence[Tensor | None]) -> TemperatureRange | None:
    """The range of thermal images in °C, rounded outwards to whole degrees; None if there are
    none."""
    limits = [image[image.isfinite()].aminmax() for image in thermal if image is not None]
    if not limits:
        return None
    return TemperatureRange.around(
        min(low.item() for low, _ in limits), max(high.item() for _, high in limits)
    )


def warn_of_kelvin(thermal: Sequence[Tensor | None]) -> None:
    """Warn of thermal images that show everyday temperatures if they are kelvin. They are used as
    they are: only the caller can know that they show a furnace.

    Warns:
        MrgsWarning: see above.
    """
    images = [image.flatten() for image in thermal if image is not None]
    sampled = [image[:: 1 + len(image) // _SAMPLED].double() for image in images]
    values = torch.cat(sampled) if sampled else torch.empty(0)
    known = values[values.isfinite()]
    if not len(known):
        return
    low, middle, high = np.percentile(known.numpy(), (1, 50, 99))
    if are_everyday(low - ZERO_CELSIUS_K, middle - ZERO_CELSIUS_K, high - ZERO_CELSIUS_K):
        warn_user(
            f"celsius has values from {low:.5g} to {high:.5g}, which look like kelvin: subtract "
            f"{ZERO_CELSIUS_K} if they are"
        )


def views_from_arrays(
    cameras: Sequence[Camera],
    rgb: Sequence[Tensor | None],
    thermal: Sequence[Tensor | None],
    thermal_cameras: Sequence[Camera],
    temperature: TemperatureRange | None,
) -> list[View]:
    """Views of images in memory, named by their number; see ``Scene.from_arrays``.

    Args:
        cameras: of the views, and of their RGB images.
        thermal_cameras: of the thermal images, one for each view.
        temperature: the scale of the temperatures; None if there are none.

    Raises:
        SceneError: a view has no image.
        ValueError: the numbers of cameras and images differ, or an image does not fit its camera.
    """
    if len(thermal_cameras) != len(cameras):
        raise ValueError(f"{len(cameras)} cameras, but {len(thermal_cameras)} thermal cameras")
    for name, images in (("rgb", rgb), ("celsius", thermal)):
        if len(images) not in (0, len(cameras)):
            raise ValueError(f"{len(cameras)} cameras, but {len(images)} images in {name}")
    views = []
    for number, (camera, colors, thermal_camera, celsius) in enumerate(
        zip_longest(cameras, rgb, thermal_cameras, thermal)
    ):
        found: dict[Modality, PosedImage] = {}
        if colors is not None:
            _check_size(colors, camera, f"rgb[{number}]")
            found[RGB] = PosedImage(camera, partial(_load_colors, colors))
        if celsius is not None and temperature is not None:
            _check_size(celsius, thermal_camera, f"celsius[{number}]")
            load = partial(_load_temperatures, celsius, temperature)
            found[THERMAL] = PosedImage(thermal_camera, load)
        if not found:
            raise SceneError(f"view {number} has no image with a known pixel: leave its camera out")
        views.append(View(f"{number:05d}", found))
    return views


def cloud_from_arrays(points: Array | None, colors: Array | None) -> PointCloud | None:
    """Start points without those that are not finite; None if there are none.

    Raises:
        ValueError: an array of another shape, or colours in another range.
    """
    if points is None:
        return None
    positions = as_tensor(points, torch.float32, (None, 3), "points")
    given = None if colors is None else _colors(colors, (None, 3), "colors")
    if given is None or not len(given):
        rgb = torch.full_like(positions, GREY)
    elif len(given) == len(positions):
        rgb = _as_shares(given).nan_to_num(GREY, GREY, GREY)
    else:
        raise ValueError(f"{len(positions)} points, but {len(given)} colors")
    finite = positions.square().isfinite().all(dim=1)  # distances are taken in float32
    return PointCloud(positions[finite], rgb[finite]) if finite.any() else None


def _listed(items: Iterable | None, name: str, what: str) -> list:
    """Items of a list, an array, a tensor or a generator; none for None."""
    try:
        return [] if items is None else list(items)
    except TypeError:
        raise ValueError(f"{name} must be a list of {what}, one for each view") from None


def _colors(array: Array, shape: tuple[int | None, ...], name: str) -> Tensor:
    """RGB as uint8, or as numbers in [0, 1] with NaN where it is not known."""
    if isinstance(array, np.ma.MaskedArray) and array.dtype == np.uint8:
        array = array.astype(np.float32) * np.float32(1 / 255)  # bytes have no NaN for the mask
    colors = as_tensor(array, None, shape, name)
    known = colors[:0] if colors.dtype == torch.uint8 else colors[colors.isfinite()]
    if known.numel():
        low, high = known.min().item(), known.max().item()
        if low < -_ROUNDING or high > 1 + _ROUNDING:
            raise ValueError(
                f"{name} has values from {low:.5g} to {high:.5g}: give uint8, or numbers in [0, 1]"
            )
    return colors


def _as_shares(colors: Tensor) -> Float32[Tensor, "*n 3"]:
    """Bytes, or numbers in [0, 1], -> numbers in [0, 1]."""
    scale = 1 / 255 if colors.dtype == torch.uint8 else 1.0
    return (colors.float() * scale).contiguous()


def _measured(celsius: Tensor, name: str) -> Tensor | None:
    """Temperatures that a camera can have measured; None if none is finite."""
    known = celsius[celsius.isfinite()]
    if not len(known):
        return None
    low, high = known.min().item(), known.max().item()
    if low < COLDEST_C or high > HOTTEST_C:
        raise ValueError(
            f"{name} has values from {low:.5g} to {high:.5g}: give °C between {COLDEST_C:g} and "
            f"{HOTTEST_C:g}, no raw counts, and NaN where a pixel is not known"
        )
    return celsius


def _check_size(image: Tensor, camera: Camera, name: str) -> None:
    size = (camera.height, camera.width)
    if image.shape[:2] != size:
        expected = [*size, *image.shape[2:]]
        raise ValueError(f"{name} must have shape {expected}, not {list(image.shape)}")


def _load_colors(colors: Tensor) -> Pixels:
    return _pixels(_as_shares(colors))


def _load_temperatures(celsius: Tensor, temperature: TemperatureRange) -> Pixels:
    return _pixels(temperature.from_celsius(celsius.float())[..., None])


def _pixels(values: Float32[Tensor, "h w c"]) -> Pixels:
    """Pixels that are not finite in all channels are not valid."""
    known = values.isfinite().all(dim=2)
    return Pixels(values) if known.all() else Pixels(values.nan_to_num(0, 0, 0), known)
