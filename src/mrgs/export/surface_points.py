"""The splats on surfaces as points with colours, temperatures and other values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from mrgs.errors import RunError
from mrgs.export.rendered import depth_maps, value_columns
from mrgs.pictures.files import to_array
from mrgs.runs.baked import BakedModel
from mrgs.scene import Scene
from mrgs.scene.depth_map import SURFACE_DEPTH, carry_over

MIN_OPACITY = 0.3
"""A splat becomes a point if one of its opacities reaches this: fainter ones fill gaps and haze,
and lie off the surfaces."""


Columns: TypeAlias = Mapping[str, Float32[np.ndarray, " m"] | UInt8[np.ndarray, " m"]]
"""Colours, temperatures and other values by their names in files."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """M points with what they carry into a file.

    Attributes:
        positions: world coordinates (scene units), [M, 3].
        columns: colours, temperatures and other values by their names in files, see
            ``value_columns``, [M] each.
        opacities: the largest of all modalities, [M].
    """

    positions: Float32[np.ndarray, "m 3"]
    columns: Columns
    opacities: Float32[np.ndarray, " m"]


def surface_points(baked: BakedModel, scene: Scene) -> SurfacePoints:
    """The centres of the splats that are opaque in any modality and lie on a surface that a
    training camera sees.

    Colours, temperatures and other values are those that the cameras see there, see ``rendered``.

    Raises:
        RunError: there is no such splat.
    """
    opacities = to_array(torch.stack(list(baked.opacities.values())).amax(dim=0))
    rows = np.flatnonzero(opacities >= MIN_OPACITY)
    if not len(rows):
        raise RunError(
            f"no splat has an opacity of {MIN_OPACITY} or more, so there are no points: train it "
            f"longer"
        )
    positions = to_array(baked.means)[rows]
    values, seen = carry_over(depth_maps(baked, scene), positions, 0.0, SURFACE_DEPTH)
    if not seen.any():
        raise RunError(
            "no opaque splat lies on a surface that a camera sees, so there are no points: train "
            "it longer"
        )
    columns = value_columns(baked, values[seen])
    return SurfacePoints(positions[seen], columns, opacities[rows[seen]])
