"""Thermal images: from pixel values to normalised temperatures, and the scale in °C."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxtyping import Bool, Float32
from torch import Tensor

from mrgs.data.files import (
    MAX_MAGNITUDE,
    contained,
    finite_number,
    read_json_object,
    scene_error,
)
from mrgs.data.images import Kind, decode, with_channels
from mrgs.data.sources import ReadingNotes
from mrgs.scene import TemperatureRange

BOUNDS_FILES = ("temperature_bounds.json", "thermal/temperature_bounds.json")


def read_bounds(root: Path, notes: ReadingNotes) -> TemperatureRange | None:
    """The scale from ``temperature_bounds.json`` in the scene's folder or in its ``thermal/``; None
    without a file.

    Raises:
        SceneError: the file is there, but does not hold two different temperatures in °C.
    """
    paths = [contained(root, name, root) for name in BOUNDS_FILES]
    path = next((path for path in paths if os.path.lexists(path)), None)
    if path is None:
        return None
    content = read_json_object(path)
    low, high = (
        finite_number(
            content.get(f"absolute_{end}_temperature"), f"absolute_{end}_temperature", path
        )
        for end in ("min", "max")
    )
    if low > high:
        low, high = high, low
        used = f"{low:g} °C to {high:g} °C".replace("-", "−")
        notes.repair(f"{path.name} has its bounds swapped; {used} is used.")
    return _range(TemperatureRange, low, high, path)


def bounds_of_images(paths: Sequence[Path]) -> TemperatureRange:
    """The range of float images in °C, rounded outwards to whole degrees.

    Raises:
        SceneError: an image cannot be decoded, or holds no temperature in °C.
    """
    low, high = math.inf, -math.inf
    for path in paths:
        values, valid, _ = decode(path)
        known = values[..., 0] if valid is None else values[..., 0][valid]
        if known.numel() == 0:
            raise scene_error(path, "holds no finite temperature; replace the file")
        if not known.abs().max() <= MAX_MAGNITUDE:
            raise scene_error(path, "holds a temperature that is not plausible; replace the file")
        low, high = min(low, known.min().item()), max(high, known.max().item())
    return _range(TemperatureRange.around, low, high, paths[0].parent)


def check_kinds(kinds: Sequence[tuple[Path, Kind]], has_bounds: bool, notes: ReadingNotes) -> Kind:
    """The common kind of all thermal images; notes what follows from it.

    Raises:
        SceneError: some images hold °C and others do not, and there are no bounds to bring them
            together.
    """
    celsius = [path for path, kind in kinds if kind == "float"]
    if celsius and len(celsius) < len(kinds) and not has_bounds:
        raise scene_error(
            celsius[0],
            "holds °C, but other thermal images do not; add temperature_bounds.json, or convert "
            "them",
        )
    if any(kind == "colour" for _, kind in kinds):
        notes.decide(
            "Thermal images have three channels: their luminance is used; it follows the "
            "temperature only if the "
            "colours are shades of grey."
        )
    if celsius:
        return "float"
    if not has_bounds:
        notes.decide(
            "The thermal images hold no °C and no temperature_bounds.json states their range: "
            "values are relative."
        )
    return "grey"


def decode_thermal(
    path: Path, temperature: TemperatureRange | None
) -> tuple[Float32[Tensor, "h w 1"], Bool[Tensor, "h w"] | None]:
    """Normalised temperatures of an image, and the mask of usable pixels (None if all are).

    Integers span the range already; °C in a float image are mapped by ``temperature``
    and not clamped.

    Raises:
        SceneError: the file cannot be decoded, or holds °C where no range is known.
    """
    values, valid, kind = decode(path)
    if kind == "colour":
        return with_channels(values, 1), valid
    if kind == "float":
        if temperature is None:
            raise scene_error(
                path, "holds °C, but the range is not known; add temperature_bounds.json"
            )
        return temperature.from_celsius(values), valid
    return values, valid


def _range(
    make: Callable[[float, float], TemperatureRange], low: float, high: float, file: Path
) -> TemperatureRange:
    try:
        return make(low, high)
    except ValueError as error:
        raise scene_error(file, f"{error}; correct the temperatures") from None
