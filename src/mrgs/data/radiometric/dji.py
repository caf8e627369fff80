"""DJI: what its R-JPEGs need before they can be read, and the bare numbers that DJI's own tool
makes of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mrgs.data.files import scene_error
from mrgs.data.radiometric.photo import Overrides, PhotoFacts, ThermalPhoto
from mrgs.data.radiometric.raster import finished
from mrgs.data.radiometric.units import FLOAT_UNITS
from mrgs.errors import SceneError

SIZES = ((640, 512), (1280, 1024), (336, 256), (160, 120), (320, 256), (640, 480))
"""Width and height of the thermal images of DJI's cameras; the bare numbers do not say their
own."""


def needs_converting(path: Path) -> SceneError:
    """The error for an R-JPEG, whose signal only DJI's library turns into temperatures."""
    return scene_error(
        path,
        "is a DJI R-JPEG, whose temperatures only DJI's Thermal SDK can read; convert it with "
        f"dji_irp -s {path.name} -a measure -o {path.stem}.raw --measurefmt float32, and use the "
        f".raw file instead",
    )


def read_bare_numbers(data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
    """The photo in a ``.raw`` file of ``dji_irp -a measure``: float32 in °C, or int16 in 0.1 °C;
    little-endian.

    The size follows from the number of bytes: all of ``SIZES`` differ in both.

    Raises:
        SceneError: the length is none that a DJI camera gives, or the numbers are no temperatures.
    """
    for form, unit in (("<f4", FLOAT_UNITS), ("<i2", ("celsius*10",))):
        for width, height in SIZES:
            if len(data) == width * height * np.dtype(form).itemsize:
                values = np.frombuffer(data, form).reshape(height, width).astype(np.float32)
                facts = PhotoFacts("output of DJI's Thermal SDK")
                return finished(values, unit, path, facts, overrides)
    raise scene_error(
        path,
        f"has {len(data)} bytes, which is no image of a DJI camera; make it with dji_irp -a "
        f"measure",
    )
