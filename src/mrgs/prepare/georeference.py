"""Scale and orientation of a reconstruction: from GPS, from a known distance, or estimated from how
the cameras were held."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from mrgs.data.radiometric import GpsPosition
from mrgs.prepare.contract import Georeference, Reconstruction
from mrgs.prepare.gps import UnusableGpsError, levelled, place_by_gps
from mrgs.prepare.known_distance import KnownDistance, length_of
from mrgs.prepare.similarity import Similarity
from mrgs.scene import PointCloud, WorldFrame

ARBITRARY = "The scale is arbitrary."
KNOWN = "The scale is that of the known distance."

_UPRIGHT = math.cos(math.radians(10))
"""Given poses whose z axis is so near to up, as the cameras were held, are upright."""


def georeference(
    reconstruction: Reconstruction,
    gps: Mapping[str, GpsPosition],
    known: KnownDistance | None = None,
    *,
    as_given: bool = False,
) -> Georeference:
    """The similarity to a world with z up, in metres and with x east and y north where possible.

    Args:
        reconstruction: poses in any world.
        gps: positions of photos by view; those of views without a pose are ignored.
        known: a length in a photo; it overrides the scale from GPS.
        as_given: the poses come from the user. Their axes stay where their file says where on Earth
            they lie, where GPS agrees with them, and where there is no usable GPS.

    Raises:
        SceneError: the known distance cannot be measured in the reconstruction.
    """
    scale = None if known is None else known.metres / length_of(known, reconstruction)
    level = levelled(reconstruction)
    if as_given and level.rotation[2, 2] > _UPRIGHT:
        level = Similarity(1.0, np.eye(3), np.zeros(3))
    positions = {name: gps[name] for name in sorted(gps) if name in reconstruction.viewmats}
    if as_given and reconstruction.world.is_georeferenced:
        return _as_given(reconstruction.world, scale)
    warnings: tuple[str, ...] = ()
    if positions:
        try:
            return place_by_gps(reconstruction, positions, level, scale, as_given=as_given)
        except UnusableGpsError as reason:
            warnings = (f"The GPS positions are not used: {reason}.",)
    if as_given:
        return _as_given(reconstruction.world, scale, warnings)
    return _without_gps(level, scale, warnings)


def apply(georeference: Georeference, reconstruction: Reconstruction) -> Reconstruction:
    """The reconstruction with poses and points in the new world."""
    rotation, translation, scale = (
        georeference.rotation,
        georeference.translation,
        georeference.scale,
    )
    viewmats = {}
    for name, viewmat in reconstruction.viewmats.items():
        moved = torch.eye(4, dtype=torch.float64)
        moved[:3, :3] = viewmat[:3, :3] @ rotation.T
        moved[:3, 3] = scale * viewmat[:3, 3] - moved[:3, :3] @ translation
        viewmats[name] = moved
    positions = scale * reconstruction.points.positions.double() @ rotation.T + translation
    points = PointCloud(positions.float(), reconstruction.points.colors)
    return replace(reconstruction, viewmats=viewmats, points=points)


def _without_gps(level: Similarity, scale: float | None, warnings: tuple[str, ...]) -> Georeference:
    factor = 1.0 if scale is None else scale
    return Georeference(
        scale=factor,
        rotation=torch.from_numpy(level.rotation),
        translation=torch.from_numpy(factor * level.translation),
        metric=scale is not None,
        north=False,
        origin=None,
        residual_m=None,
        text=f"{ARBITRARY if scale is None else KNOWN} North is not known; up is guessed from how "
        f"the cameras were held.",
        warnings=warnings,
    )


def _as_given(
    world: WorldFrame, scale: float | None, warnings: tuple[str, ...] = ()
) -> Georeference:
    """The frame of the given poses, of which their file may know something; only a known distance
    changes their scale."""
    origin = None if world.origin is None else GpsPosition(*world.origin)
    metres = "The scale is that of the given poses, in metres." if world.metric else ARBITRARY
    axes = "The axes are those of the given poses"
    return Georeference(
        scale=1.0 if scale is None else scale,
        rotation=torch.eye(3, dtype=torch.float64),
        translation=torch.zeros(3, dtype=torch.float64),
        metric=world.metric or scale is not None,
        north=world.north,
        origin=origin,
        residual_m=world.residual_m,
        text=f"{metres if scale is None else KNOWN} {axes}{', with north' * world.north}.",
        warnings=warnings,
        scale_error=world.scale_error if scale is None else None,
    )
