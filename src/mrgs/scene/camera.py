"""A pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

MIN_DEPTH = 1e-6
"""Scene units; a point nearer to the plane through the camera's centre may lie on either side of
it, by rounding."""


class CameraTensors(NamedTuple):
    """A camera's numbers where they are computed with: K [3, 3], viewmat [4, 4] and position [3],
    see ``Camera``."""

    K: Float[Tensor, "3 3"]
    viewmat: Float[Tensor, "4 4"]
    position: Float[Tensor, "3"]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward.

    The centre of the pixel in column u and row v lies at (u + 0.5, v + 0.5); a world point X
    projects to K · (R X + t), with [R | t] the upper rows of ``viewmat``.

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
    _tensors: dict[tuple[torch.device, torch.dtype], CameraTensors] = field(
        default_factory=dict, init=False, repr=False
    )

    def tensors(self, device: torch.device, dtype: torch.dtype = torch.float64) -> CameraTensors:
        """The camera on a device; kept, because to copy it for every image would make the host wait
        for a GPU."""
        if (device, dtype) not in self._tensors:
            position = self.position
            self._tensors[device, dtype] = CameraTensors(
                *(tensor.to(device, dtype) for tensor in (self.K, self.viewmat, position))
            )
        return self._tensors[device, dtype]

    @property
    def position(self) -> Float64[Tensor, "3"]:
        """The centre of projection in world coordinates."""
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        return -rotation.T @ translation

    @property
    def forward(self) -> Float64[Tensor, "3"]:
        """The viewing direction (the optical axis) in world coordinates, unit length."""
        return self.viewmat[2, :3]

    def project(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
        """Where points of the world appear, in the points' precision.

        Args:
            points: world coordinates in scene units, [..., 3].

        Returns:
            Pixel coordinates x (right) and y (down), [..., 2], which may lie outside the image, and
            are NaN for points that are not before the camera (z below ``MIN_DEPTH``); and the
            z-depths in scene units, [...].
        """
        K, viewmat = self.K.to(points), self.viewmat.to(points)
        in_camera = points @ viewmat[:3, :3].mT + viewmat[:3, 3]
        depth = in_camera[..., 2]
        before = torch.where(depth >= MIN_DEPTH, depth, torch.nan)
        return in_camera[..., :2] / before[..., None] * K.diagonal()[:2] + K[:2, 2], depth

    def unproject(
        self, pixels: Float[Tensor, "*batch 2"], depth: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 3"]:
        """The points of the world that appear at pixel coordinates, in the precision of these;
        undoes ``project``.

        Args:
            pixels: x and y, [..., 2].
            depth: z-depths in scene units, [...].

        Returns:
            World coordinates in scene units, [..., 3].
        """
        K, viewmat = self.K.to(pixels), self.viewmat.to(pixels)
        rays = torch.nn.functional.pad((pixels - K[:2, 2]) / K.diagonal()[:2], (0, 1), value=1.0)
        return (rays * depth[..., None] - viewmat[:3, 3]) @ viewmat[:3, :3]

    def unproject_image(self, depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
        """The points of the world that appear at the centres of the pixels, for z-depths in scene
        units."""
        row, column = torch.meshgrid(
            *(torch.arange(size).to(depth) + 0.5 for size in depth.shape), indexing="ij"
        )
        return self.unproject(torch.stack([column, row], dim=2), depth)

    def contains(self, pixels: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
        """Whether pixel coordinates x and y, [..., 2], lie in the image; NaN does not."""
        size = pixels.new_tensor([self.width, self.height])
        return ((pixels >= 0) & (pixels < size)).all(dim=-1)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera on another pixel grid; the field of view is kept exactly."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0], dtype=torch.float64)
        return Camera(self.K * scale[:, None], self.viewmat, width, height)

    def with_width(self, width: int) -> Camera:
        """The same camera on a pixel grid of this width, its height in proportion."""
        return self.resized(width, max(1, round(self.height * width / self.width)))

    def coincides_with(self, other: Camera) -> bool:
        """Whether both cameras see the same rays on the same pixel grid, so that one pass can serve
        both."""
        return (
            (self.width, self.height) == (other.width, other.height)
            and torch.equal(self.K, other.K)
            and torch.equal(self.viewmat, other.viewmat)
        )
