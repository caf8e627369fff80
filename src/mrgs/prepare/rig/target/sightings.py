"""Detection of the target in all pairs, and the order of its corners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mrgs.errors import SceneError
from mrgs.prepare.rig.contract import ChessboardTarget, RigPair
from mrgs.prepare.rig.images import grey_plane
from mrgs.prepare.rig.target.detect import Corners, detect_chessboard
from mrgs.scene import Camera


@dataclass(frozen=True, eq=False)
class Sighting:
    """The target as a pair shows it.

    Attributes:
        name: of the pair.
        camera: of the photo.
        photo: the corners in the photo.
        thermal: the same corners, in the same order, in the thermal image; None if it does not show
            them.
    """

    name: str
    camera: Camera
    photo: Corners
    thermal: Corners | None

    @property
    def rays(self) -> Float[np.ndarray, "n 2"]:
        """x / z and y / z of the corners, in the axes of the photo's camera."""
        K = self.camera.K.numpy()
        return (self.photo.pixels - K[:2, 2]) / K[[0, 1], [0, 1]]

    def orderings(self) -> list[Sighting]:
        """The sighting in each order of the corners that looks the same."""
        photos = self.photo.orderings()
        thermals = [None] * len(photos) if self.thermal is None else self.thermal.orderings()
        return [
            Sighting(self.name, self.camera, p, t) for p, t in zip(photos, thermals, strict=True)
        ]


def find_sightings(
    pairs: Sequence[RigPair], target: ChessboardTarget, report: Callable[[str, int, int], None]
) -> list[Sighting]:
    """Detect the target in all pairs; returns a sighting for each photo that shows it.

    Args:
        pairs: photos and thermal images, with the same side up.
        report: called with a stage's name, and how many of its steps are done and there are.

    Raises:
        SceneError: no pair shows it in both images, or an image cannot be read.
    """
    found, in_thermal = [], 0
    for index, pair in enumerate(pairs):
        report("looking for the target", index, len(pairs))
        photo = detect_chessboard(grey_plane(pair.photo.load(), pair.name).values, target.inner)
        thermal = detect_chessboard(grey_plane(pair.load_thermal(), pair.name).values, target.inner)
        in_thermal += thermal is not None
        if photo is not None:
            ordered = None if thermal is None else _in_order_of(photo, thermal)
            found.append(Sighting(pair.name, pair.photo.camera, photo, ordered))
    if not any(sighting.thermal is not None for sighting in found):
        columns, rows = target.inner
        raise SceneError(
            f"no pair shows the chessboard of {columns}×{rows} inner corners in both images (it "
            f"was found in {len(found)} photos and {in_thermal} thermal images of {len(pairs)}): "
            f"check the counts, which are of the corners where four squares meet and not of the "
            f"squares, or give no target",
            options=("target",),
        )
    return found


def _in_order_of(photo: Corners, thermal: Corners) -> Corners:
    """The thermal corners in the photo's order: the one with the least rotation between the two
    images."""

    def agreement(corners: Corners) -> float:
        a, b = (each.pixels - each.pixels.mean(axis=0) for each in (photo, corners))
        return float((a * b).sum())

    return max(thermal.orderings(), key=agreement)
