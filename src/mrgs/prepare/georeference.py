"""Scale and orientation of a reconstruction: from GPS, from a known distance, or estimated from how
the cameras were held."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from mrgs.data.radiometric import GpsPosition
from mrgs.prepare.contract import Georeference, Reconstruction
from mrgs.prepare.gps import UnusableGpsError, place_by_gps
from mrgs.prepare.known_distance import KnownDistance, length_of
from mrgs.prepare.levelling import levelled
from mrgs.prepare.similarity import Similarity
from mrgs.scene import PointCloud

__all__ = ["KnownDistance", "apply", "georeference"]


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
        as_given: the poses come from the user: only their scale changes, and only by ``known``.

    Raises:
        SceneError: the known distance cannot be measured in the reconstruction.
    """
    scale = None if known is None else known.metres / length_of(known, reconstruction)
    if as_given:
        return _without_gps(
            Similarity(1.0, np.eye(3), np.zeros(3)), scale, "The axes are those of the given poses."
        )
    level = levelled(reconstruction)
    positions = {name: gps[name] for name in sorted(gps) if name in reconstruction.viewmats}
    warnings: tuple[str, ...] = ()
    if positions:
        try:
            return place_by_gps(reconstruction, positions, level, scale)
        except UnusableGpsError as reason:
            warnings = (f"The GPS positions are not used: {reason}.",)
    return _without_gps(
        level, scale, "North is not known; up is guessed from how the cameras were held.", warnings
    )


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


def _without_gps(
    similarity: Similarity, scale: float | None, text: str, warnings: tuple[str, ...] = ()
) -> Georeference:
    factor = 1.0 if scale is None else scale
    says = (
        "The scale is arbitrary." if scale is None else "The scale is that of the known distance."
    )
    return Georeference(
        scale=factor,
        rotation=torch.from_numpy(similarity.rotation),
        translation=torch.from_numpy(factor * similarity.translation),
        metric=scale is not None,
        north=False,
        origin=None,
        residual_m=None,
        text=f"{says} {text}",
        warnings=warnings,
    )
