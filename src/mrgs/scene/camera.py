"""A pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward.

    The centre of the pixel in column u and row v lies at (u + 0.5, v + 0.5); a world point X projects to
    K · (R X + t), with [R | t] the upper rows of ``viewmat``.

    Attributes:
        K: intrinsics in pixels, [3, 3]; fx and fy may differ, the skew is zero.
        viewmat: world to camera, [4, 4], a rotation and a translation in scene units.
        width: image width in pixels.
        height: image height in pixels.
    """

    K: Float64[Tensor, "3 3"]
    viewmat: Float64[Tensor, "4 4"]
    width: int
    height: int

    @property
    def position(self) -> Float64[Tensor, "3"]:
        """The centre of projection in world coordinates."""
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        return -rotation.T @ translation

    @property
    def forward(self) -> Float64[Tensor, "3"]:
        """The viewing direction (the optical axis) in world coordinates, unit length."""
        return self.viewmat[2, :3]

    def resized(self, width: int, height: int) -> Camera:
        """The same camera on another pixel grid; the field of view is kept exactly."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0], dtype=torch.float64)
        return Camera(self.K * scale[:, None], self.viewmat, width, height)

    def with_width(self, width: int) -> Camera:
        """The same camera on a pixel grid of this width, its height in proportion."""
        return self.resized(width, max(1, round(self.height * width / self.width)))

    def coincides_with(self, other: Camera) -> bool:
        """Whether both cameras see the same rays on the same pixel grid, so that one pass can serve both."""
        return (
            (self.width, self.height) == (other.width, other.height)
            and torch.equal(self.K, other.K)
            and torch.equal(self.viewmat, other.viewmat)
        )
