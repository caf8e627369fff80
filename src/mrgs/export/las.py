"""LAS 1.4 point clouds with the temperature as an extra dimension."""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import numpy as np

from mrgs.errors import ConfigError
from mrgs.export.points import TemperaturePoints
from mrgs.system.atomic import replacing

POINT_FORMAT = 7
"""The format of LAS 1.4 that holds RGB."""

FINEST_STEP = 1e-6
"""Coordinates are integers times a power of ten, this or as much larger as the points' spread
needs."""


def write_las(path: Path, points: TemperaturePoints) -> Path:
    """Write coordinates, 16-bit RGB, and the dimensions ``temperature_c`` (or _normalised) and
    ``opacity``, float32.

    There is no coordinate reference system: positions are in the scene's own frame.

    Raises:
        ConfigError: laspy is not installed.
        RunError: the file cannot be written.
    """
    laspy = require_laspy()
    header = laspy.LasHeader(point_format=POINT_FORMAT, version="1.4")
    header.generating_software = "mrgs"
    in_celsius = points.temperature_name == "temperature_c"
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(
                points.temperature_name, np.float32, "degrees Celsius" if in_celsius else "no unit"
            ),
            laspy.ExtraBytesParams("opacity", np.float32, "0 to 1"),
        ]
    )
    positions = points.positions.astype(np.float64)
    low, high = positions.min(axis=0), positions.max(axis=0)
    header.offsets = low
    header.scales = np.full(
        3, max(FINEST_STEP, 10.0 ** math.ceil(math.log10(max((high - low).max(), 1e-300) / 2e9)))
    )
    las = laspy.LasData(header)
    las.x, las.y, las.z = positions.T
    las.red, las.green, las.blue = points.colors.T.astype(np.uint16) * 257
    las[points.temperature_name] = points.temperatures
    las["opacity"] = points.opacities
    with replacing(path) as temporary:
        las.write(temporary)
    return path


def require_laspy() -> ModuleType:
    """The package laspy.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import laspy
    except ImportError:
        raise ConfigError('LAS files need the package laspy: pip install "mrgs[export]"') from None
    return laspy
