"""The images of a pair at the working size of the calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from mrgs.data.images import DRAFT_MARGIN, LUMINANCE
from mrgs.data.undistort import resize
from mrgs.errors import SceneError
from mrgs.prepare.rig.contract import RigPair
from mrgs.prepare.rig.depth import FEWEST_POINTS, InverseDepth, inverse_depth
from mrgs.scene import Camera, Pixels

PHOTO_WIDTH_PX = 640
THERMAL_WIDTH_PX = 320
"""More pixels add nothing in images as soft as thermal ones, where patches are matched to a tenth
of a pixel."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A grey image [H, W] and the mask of its usable pixels; None if all are."""

    values: Float32[np.ndarray, "h w"]
    valid: Bool[np.ndarray, "h w"] | None = None

    def resized(self, width: int, height: int) -> Plane:
        """The same field of view on another pixel grid, low-pass filtered if that is coarser."""
        valid = None if self.valid is None else torch.from_numpy(self.valid)
        values, valid = resize(torch.from_numpy(self.values)[..., None], valid, width, height)
        return Plane(values[..., 0].numpy(), None if valid is None else valid.numpy())


@dataclass(frozen=True, eq=False)
class ReducedPair:
    """A pair at working size.

    Attributes:
        name: the pair's.
        photo: its luma.
        camera: of ``photo``, at its working size.
        depth: of the surfaces in ``photo``.
        thermal: the thermal image, with lens distortion.
    """

    name: str
    photo: Plane
    camera: Camera
    depth: InverseDepth
    thermal: Plane


def reduced_pair(
    pair: RigPair, points: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "k 3"]
) -> tuple[ReducedPair | None, tuple[int, int]]:
    """The pair at working size, None if its photo sees too few points; and the thermal file's width
    and height.

    Args:
        pair: at full size.
        points: sparse points of the scene, in the world.
        target: points of a target that this photo sees, in the world; none if it sees no target.

    Raises:
        SceneError: an image cannot be read.
    """
    thermal = pair.load_thermal()
    height, width = thermal.values.shape[:2]
    camera = pair.photo.camera
    camera = camera.with_width(min(PHOTO_WIDTH_PX, camera.width))
    visible = (
        None
        if pair.visible is None
        else np.append(pair.visible.numpy(), len(points) + np.arange(len(target)))
    )
    depth = inverse_depth(np.concatenate([points, target]), camera, visible)
    if depth is None:
        return None, (width, height)
    reduced = min(THERMAL_WIDTH_PX, width)
    photo = grey_plane(pair.photo.look(DRAFT_MARGIN * PHOTO_WIDTH_PX), pair.name)
    return ReducedPair(
        name=pair.name,
        photo=photo.resized(camera.width, camera.height),
        camera=camera,
        depth=depth,
        thermal=grey_plane(thermal, pair.name).resized(
            reduced, max(1, round(height * reduced / width))
        ),
    ), (width, height)


def too_few_points(names: list[str]) -> SceneError:
    """The error of too few photos with enough sparse points."""
    return SceneError(
        f"the thermal camera cannot be placed: only {len(names)} photos see {FEWEST_POINTS} or "
        "more sparse points; take more overlapping photos, or say that one camera took both images",
        options=("one_camera",),
    )


def grey_plane(pixels: Pixels, name: str) -> Plane:
    """The luma of a photo, or the only channel; unusable pixels get the median.

    Raises:
        SceneError: no pixel is usable.
    """
    values: Tensor = pixels.values
    grey = values[..., 0] if values.shape[-1] == 1 else (values * LUMINANCE).sum(dim=-1)
    valid = torch.isfinite(grey) if pixels.valid is None else pixels.valid & torch.isfinite(grey)
    if not valid.any():
        raise SceneError(f"no pixel of {name} can be used; remove the pair")
    filled = torch.where(valid, grey, grey[valid].median())
    return Plane(filled.numpy().astype(np.float32), None if valid.all() else valid.numpy())
