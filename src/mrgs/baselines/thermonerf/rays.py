"""Rays through pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.baselines.thermonerf.frame import SceneFrame
from mrgs.scene import Camera


class Rays(NamedTuple):
    """Half lines from camera centres.

    Attributes:
        origins: in radii from the scene's centre, [R, 3].
        directions: unit vectors in world axes, [R, 3].
        cosines: of the angles to the optical axes, [R]: distance along the ray times this is
            z-depth.
    """

    origins: Float[Tensor, "r 3"]
    directions: Float[Tensor, "r 3"]
    cosines: Float[Tensor, " r"]


class CameraRays:
    """The rays of many cameras, whose pixels are numbered row by row, camera after camera.

    Args:
        cameras: at least one.
        frame: of the scene.
    """

    def __init__(self, cameras: list[Camera], frame: SceneFrame) -> None:
        self._widths = torch.tensor([camera.width for camera in cameras])
        counts = torch.tensor([camera.width * camera.height for camera in cameras])
        self._ends = counts.cumsum(dim=0)
        self._starts = self._ends - counts
        self._lenses = torch.stack([camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in cameras])
        self._rotations = torch.stack([camera.viewmat[:3, :3] for camera in cameras])
        self._origins = frame.normalised(
            torch.stack([camera.position for camera in cameras])
        ).float()

    def __len__(self) -> int:
        return int(self._ends[-1])

    def through(self, pixels: Int64[Tensor, " r"]) -> Rays:
        """The rays through the centres of pixels, in float32."""
        image = torch.searchsorted(self._ends, pixels, right=True)
        place, width = pixels - self._starts[image], self._widths[image]
        fx, fy, cx, cy = self._lenses[image].unbind(dim=1)
        x = (place % width + 0.5 - cx) / fx
        y = (torch.div(place, width, rounding_mode="floor") + 0.5 - cy) / fy
        in_camera = torch.stack([x, y, torch.ones_like(x)], dim=1)
        lengths = in_camera.norm(dim=1)
        # d_world = Rᵀ d_camera; written out, because a library's product starts threads of its own.
        directions = (in_camera[:, :, None] * self._rotations[image]).sum(dim=1) / lengths[:, None]
        return Rays(self._origins[image], directions.float(), (1 / lengths).float())
