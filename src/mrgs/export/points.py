"""The splats on surfaces as coloured points with temperatures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from mrgs.data.ply import table, write_ply
from mrgs.errors import RunError
from mrgs.export.rendered import carry_over, depth_maps
from mrgs.export.splats import temperature_name, to_bytes, to_float32
from mrgs.runs.baked import BakedModel
from mrgs.scene import Scene

MIN_OPACITY = 0.3
"""A splat becomes a point if o_c or o_t reaches this: fainter ones fill gaps and haze, and lie off
the surfaces."""


SURFACE_DEPTH = 0.03
"""A splat lies on a surface that a camera sees if the two depths differ by less than this share."""


@dataclass(frozen=True, eq=False)
class TemperaturePoints:
    """M points with what they carry into a file.

    Attributes:
        positions: world coordinates (scene units), [M, 3].
        colors: [M, 3].
        temperatures: °C, or normalised where the scene has no °C, [M].
        temperature_name: which of the two: ``temperature_c`` or ``temperature_normalised``.
        opacities: the larger of o_c and o_t, [M].
    """

    positions: Float32[np.ndarray, "m 3"]
    colors: UInt8[np.ndarray, "m 3"]
    temperatures: Float32[np.ndarray, " m"]
    temperature_name: str
    opacities: Float32[np.ndarray, " m"]


def temperature_points(baked: BakedModel, scene: Scene) -> TemperaturePoints:
    """The centres of the splats that are opaque in either modality and lie on a surface that a
    training camera sees.

    Colours and temperatures are those that the cameras see there, see ``rendered``.

    Raises:
        RunError: there is no such splat.
    """
    opacities = to_float32(torch.maximum(baked.opacity_rgb, baked.opacity_thermal))
    rows = np.flatnonzero(opacities >= MIN_OPACITY)
    if not len(rows):
        raise RunError(
            f"no splat has an opacity of {MIN_OPACITY} or more, so there are no points: train it "
            f"longer"
        )
    positions = to_float32(baked.means)[rows]
    values, seen = carry_over(depth_maps(baked, scene), positions, 0.0, SURFACE_DEPTH)
    if not seen.any():
        raise RunError(
            "no opaque splat lies on a surface that a camera sees, so there are no points: train "
            "it longer"
        )
    return TemperaturePoints(
        positions[seen],
        to_bytes(values[seen, :3]),
        values[seen, 3],
        temperature_name(baked),
        opacities[rows[seen]],
    )


def write_points_ply(path: Path, points: TemperaturePoints, comments: Sequence[str] = ()) -> Path:
    """Write x, y, z, red, green, blue, the temperature and the opacity; returns the path.

    Raises:
        RunError: the file cannot be written.
    """
    columns: dict[str, np.ndarray] = {axis: points.positions[:, i] for i, axis in enumerate("xyz")}
    columns |= {name: points.colors[:, i] for i, name in enumerate(("red", "green", "blue"))}
    columns |= {points.temperature_name: points.temperatures, "opacity": points.opacities}
    return write_ply(path, {"vertex": table(columns)}, comments)
