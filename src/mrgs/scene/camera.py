"""A pinhole camera, and smooth camera paths for fly-throughs, from the cameras of a capture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.scene.arrays import Array, as_finite, as_floats, as_whole
from mrgs.scene.rotations import (
    OPENGL_FROM_OPENCV,
    checked_intrinsics,
    checked_pose,
    rigid_transform,
)

MIN_DEPTH = 1e-6
"""Scene units; a point nearer to the camera's plane may be on either side of it, by rounding."""


class CameraTensors(NamedTuple):
    """A camera's numbers on a device: K [3, 3], viewmat [4, 4] and position [3], see ``Camera``."""

    K: Float[Tensor, "3 3"]
    viewmat: Float[Tensor, "4 4"]
    position: Float[Tensor, "3"]


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward.

    The centre of the pixel in column u and row v is at (u + 0.5, v + 0.5); a world point X
    projects to K · (R X + t), with [R | t] the upper rows of ``viewmat``.

    ``K`` and ``viewmat`` may be given as arrays or nested lists; float64 copies of them are kept.

    Attributes:
        K: intrinsics in pixels, [3, 3]; fx and fy may differ, the skew is zero.
        viewmat: world to camera, [4, 4], a rotation and a translation in scene units. Of a rotation
            that was rounded to few digits the nearest one is kept.

    Raises:
        ValueError: not the matrices of such a camera, or a size that is not a whole number of
            pixels above 0.
    """

    K: Float64[Tensor, "3 3"]
    viewmat: Float64[Tensor, "4 4"]
    width: int
    height: int
    _tensors: dict[tuple[torch.device, torch.dtype], CameraTensors] = field(init=False)
    _resized: dict[tuple[int, int], Camera] = field(init=False)

    def __init__(self, K: Array, viewmat: Array, width: int, height: int) -> None:
        width, height = as_whole(width, "width"), as_whole(height, "height")
        if width < 1 or height < 1:
            raise ValueError(f"a camera needs at least one pixel, not {width}×{height}")
        vars(self).update(
            K=checked_intrinsics(as_finite(K, (3, 3), "K")),
            viewmat=checked_pose(as_finite(viewmat, (4, 4), "viewmat")),
            width=width,
            height=height,
            _tensors={},
            _resized={},
        )

    @classmethod
    def from_pose(
        cls,
        K: Array,
        camera_to_world: Array,
        width: int,
        height: int,
        axes: Literal["opencv", "opengl"] = "opencv",
    ) -> Camera:
        """A camera from its pose in the world, [4, 4], as robots and most programs have it. Its
        axes are x right, y down, z forward, or with "opengl" x right, y up, z backward, as those of
        nerfstudio and Blender. Errors as for ``Camera``, and ValueError for other axes."""
        if axes not in ("opencv", "opengl"):
            raise ValueError(f"axes are 'opencv' or 'opengl', not {axes!r}")
        pose = as_finite(camera_to_world, (4, 4), "camera_to_world")
        if axes == "opengl":
            pose = pose @ torch.from_numpy(OPENGL_FROM_OPENCV)
        rotation, position = checked_pose(pose)[:3].split([3, 1], dim=1)
        viewmat = rigid_transform(rotation.T, -(rotation.T @ position)[:, 0])
        return cls(K, viewmat, width, height)

    @classmethod
    def from_fov(cls, width: int, height: int, fov_deg: float) -> Camera:
        """A camera at the origin with square pixels, its axis in the middle of the image, and a
        horizontal field of view of ``fov_deg`` degrees, between 0 and 180. It looks along +z; place
        it with ``look_at``. ValueError for a field of view out of range, or a size that is not a
        whole number of pixels above 0."""
        width, height = as_whole(width, "width"), as_whole(height, "height")
        if not 0 < fov_deg < 180:
            raise ValueError(f"a field of view lies between 0° and 180°, not {fov_deg}°")
        focal = focal_length(width, math.radians(fov_deg))
        K = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
        return cls(K, torch.eye(4), width, height)

    def look_at(self, position: Array, target: Array, up: Array = (0.0, 0.0, 1.0)) -> Camera:
        """The same camera at another place, its axis through a target.

        Args:
            position: of the centre of projection, world coordinates, [3].
            target: a point that appears on the optical axis, world coordinates, [3].
            up: the world direction that points up in the image, [3]; +z by default.

        Raises:
            ValueError: not three finite numbers each, the target is the position, or ``up`` points
                along the axis.
        """
        return Camera(self.K, viewmat_towards(position, target, up), self.width, self.height)

    def __repr__(self) -> str:
        fov = math.degrees(field_of_view(self.width, self.K[0, 0].item()))
        x, y, z = self.position.tolist()
        return f"Camera({self.width}×{self.height}, {fov:.0f}° wide, at {x:.3g}, {y:.3g}, {z:.3g})"

    def tensors(self, device: torch.device, dtype: torch.dtype = torch.float64) -> CameraTensors:
        """The camera on a device; kept, because a copy for each image makes the host wait."""
        if (device, dtype) not in self._tensors:
            own = self.K, self.viewmat, self.position
            copies = (tensor.to(device, dtype, copy=True) for tensor in own)
            self._tensors[device, dtype] = CameraTensors(*copies)
        return self._tensors[device, dtype]

    def recording_copy(self) -> Camera:
        """A copy with ``tensors`` of its own, for ``copy_numbers_from``."""
        return Camera(self.K, self.viewmat, self.width, self.height)

    def copy_numbers_from(self, other: Camera) -> None:
        """Have the ``tensors`` that were asked of this camera, and of its ``resized`` ones, hold
        another's numbers: what a GPU has recorded reads these tensors. All else stays as it is.
        ``other`` has the same ``K``, width and height."""
        for (device, dtype), tensors in self._tensors.items():
            for tensor, value in zip(tensors, other.tensors(device, dtype), strict=True):
                tensor.copy_(value)
        for size, resized in self._resized.items():
            resized.copy_numbers_from(other.resized(*size))

    @property
    def position(self) -> Float64[Tensor, "3"]:
        """The centre of projection in world coordinates."""
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        return -rotation.T @ translation

    @property
    def forward(self) -> Float64[Tensor, "3"]:
        """The viewing direction (the optical axis) in world coordinates, unit length."""
        return self.viewmat[2, :3]

    def project(self, points: Array) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
        """Where points of the world, [..., 3] in scene units, appear, in their precision; integers
        count as float64.

        Returns:
            Pixel coordinates x (right) and y (down), [..., 2], which may lie outside the image, and
            are NaN for points that are not before the camera (z below ``MIN_DEPTH``); and the
            z-depths in scene units, [...]. ValueError for an array of another shape.
        """
        points = as_floats(points, "points", 3)
        K, viewmat = self.K.to(points), self.viewmat.to(points)
        in_camera = points @ viewmat[:3, :3].mT + viewmat[:3, 3]
        depth = in_camera[..., 2]
        before = torch.where(depth >= MIN_DEPTH, depth, torch.nan)
        return in_camera[..., :2] / before[..., None] * K.diagonal()[:2] + K[:2, 2], depth

    def unproject(self, pixels: Array, depth: Array | float) -> Float[Tensor, "*batch 3"]:
        """The points of the world that appear at pixel coordinates, in the precision of these;
        undoes ``project``.

        Args:
            pixels: x and y, [..., 2].
            depth: z-depths in scene units, [...], or one for all.

        Returns:
            World coordinates in scene units, [..., 3].

        Raises:
            ValueError: arrays of another shape.
        """
        pixels, depth = as_floats(pixels, "pixels", 2), as_floats(depth, "depth")
        if depth.ndim and depth.shape != pixels.shape[:-1]:
            raise ValueError(
                f"depth must have shape {list(pixels.shape[:-1])}, not {list(depth.shape)}"
            )
        K, viewmat = self.K.to(pixels), self.viewmat.to(pixels)
        rays = torch.nn.functional.pad((pixels - K[:2, 2]) / K.diagonal()[:2], (0, 1), value=1.0)
        return (rays * depth[..., None] - viewmat[:3, 3]) @ viewmat[:3, :3]

    def unproject_image(self, depth: Array) -> Float[Tensor, "h w 3"]:
        """The points of the world that appear at the centres of the pixels, for z-depths in scene
        units, [H, W]. ValueError for an array of another shape."""
        depth = as_floats(depth, "depth")
        if depth.ndim != 2:
            raise ValueError(f"depth must have shape [H, W], not {list(depth.shape)}")
        row, column = torch.meshgrid(
            *(torch.arange(size).to(depth) + 0.5 for size in depth.shape), indexing="ij"
        )
        return self.unproject(torch.stack([column, row], dim=2), depth)

    def contains(self, pixels: Array) -> Bool[Tensor, "*batch"]:
        """Whether pixel coordinates x and y, [..., 2], lie in the image; NaN does not. ValueError
        for an array of another shape."""
        pixels = as_floats(pixels, "pixels", 2)
        size = pixels.new_tensor([self.width, self.height])
        return ((pixels >= 0) & (pixels < size)).all(dim=-1)

    @property
    def focal_px(self) -> float:
        """Geometric mean of both focal lengths, pixels."""
        K = self.K.numpy()
        return math.sqrt(K[0, 0] * K[1, 1])

    def resized(self, width: int, height: int) -> Camera:
        """The same camera on another pixel grid; the field of view is kept exactly. Kept, for the
        sake of its ``tensors``."""
        size = width, height
        if size not in self._resized:
            scale = self.K.new_tensor([width / self.width, height / self.height, 1.0])
            self._resized[size] = Camera(self.K * scale[:, None], self.viewmat, width, height)
        return self._resized[size]

    def with_width(self, width: int) -> Camera:
        """The same camera on a pixel grid of this width, its height in proportion."""
        return self.resized(width, max(1, round(self.height * width / self.width)))

    def at_most(self, width: int) -> Camera:
        """The same camera on a pixel grid of at most this width."""
        return self if self.width <= width else self.with_width(width)

    def moved(self, motion: Float64[Tensor, "4 4"]) -> MovedCamera:
        """The camera as it sees a world that a rigid motion has moved, to learn that motion."""
        return MovedCamera(self, motion)

    def coincides_with(self, other: Camera) -> bool:
        """Whether both cameras see the same rays on the same grid, so that one pass serves both."""
        return (
            (self.width, self.height) == (other.width, other.height)
            and torch.equal(self.K, other.K)
            and torch.equal(self.viewmat, other.viewmat)
        )


def field_of_view(pixels: float, focal_px: float) -> float:
    """Angle of view of a number of pixels about the optical axis, radians."""
    return 2 * math.atan(0.5 * pixels / focal_px)


def focal_length(pixels: float, angle: float) -> float:
    """The focal length whose ``field_of_view`` of a number of pixels this is, in their unit."""
    return pixels / 2 / math.tan(angle / 2)


def viewmat_towards(
    position: Array, target: Array, up: Array = (0.0, 0.0, 1.0)
) -> Float64[Tensor, "4 4"]:
    """World to camera of a camera at a place, its axis through a target; see ``Camera.look_at``."""
    given = {"position": position, "target": target, "up": up}
    here, there, upwards = (as_finite(value, (3,), name) for name, value in given.items())
    forward = there - here
    right = torch.linalg.cross(forward, upwards)
    if not right.norm() > 1e-9 * forward.norm() * upwards.norm():
        raise ValueError("up must not point along the viewing direction, nor either be zero")
    axes = torch.stack([right, torch.linalg.cross(forward, right), forward])
    rotation = axes / axes.norm(dim=1, keepdim=True)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ here
    return viewmat


class MovedCamera(Camera):
    """A camera that sees a world which a rigid motion has moved: what learns poses renders with it.

    Its ``tensors`` are moved and carry the gradient of the motion, which may lie on a GPU. The
    position carries none, and all else (``viewmat``, ``project``, ...) is as before the motion.

    Args:
        motion: of the world, [4, 4]: a point X is seen where the camera saw motion · X.
    """

    _before: Camera
    _motion: Float64[Tensor, "4 4"]
    _moved: CameraTensors

    def __init__(self, camera: Camera, motion: Float64[Tensor, "4 4"]) -> None:
        K, viewmat, _ = camera.tensors(motion.device)
        viewmat = viewmat @ motion
        rotation, translation = viewmat.detach()[:3, :3], viewmat.detach()[:3, 3]
        moved = CameraTensors(K, viewmat, -rotation.T @ translation)
        vars(self).update(vars(camera), _before=camera, _motion=motion, _moved=moved)

    def tensors(self, device: torch.device, dtype: torch.dtype = torch.float64) -> CameraTensors:
        """The moved camera on a device."""
        return CameraTensors(*(tensor.to(device, dtype) for tensor in self._moved))

    def resized(self, width: int, height: int) -> Camera:
        """The same camera on another pixel grid, moved alike."""
        return MovedCamera(self._before.resized(width, height), self._motion)


def orbit(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A closed ellipse through the middle of the cameras, each pose looking at the point that they
    look at, in the plane that fits the camera centres best; half axes are √2 standard deviations,
    so that cameras spread evenly over an ellipse get that ellipse back. Intrinsics are the first
    camera's; of the ``frames`` poses the last is followed by the first. ConfigError without
    cameras, or for fewer than one frame."""
    if not cameras:
        raise ConfigError("a camera path needs at least one training camera")
    if frames < 1:
        raise ConfigError(f"a camera path needs at least one frame, got {frames}")
    positions = np.stack([camera.position.numpy() for camera in cameras])
    centre = positions.mean(axis=0)
    _, spread, axes = np.linalg.svd(positions - centre, full_matrices=True)
    spread = np.pad(spread, (0, 3))[:2] / np.sqrt(len(cameras))
    angles = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    target = focus_point(cameras)
    mean_up = -np.stack([camera.viewmat[1, :3].numpy() for camera in cameras]).mean(axis=0)
    path = []
    for position in centre + np.sqrt(2) * (circle * spread) @ axes[:2]:
        forward, up = target - position, mean_up
        if np.linalg.norm(np.cross(forward, up)) < 1e-6 * np.linalg.norm(forward):
            up = np.eye(3)[np.abs(forward).argmin()]
        path.append(cameras[0].look_at(position, target, up))
    return path


def focus_point(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """The point closest to all optical axes (least squares); where they hardly meet, or behind the
    cameras, the point ahead of the cameras' centre at the distance of their spread."""
    positions = np.stack([camera.position.numpy() for camera in cameras])
    directions = np.stack([camera.forward.numpy() for camera in cameras])
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    system = across.sum(axis=0)
    if np.linalg.eigvalsh(system)[0] > 1e-3 * len(cameras):
        point = np.linalg.solve(system, (across @ positions[:, :, None]).sum(axis=0)[:, 0])
        if np.median(((point - positions) * directions).sum(axis=1)) > 0:
            return point
    centre = positions.mean(axis=0)
    distance = 2 * np.linalg.norm(positions - centre, axis=1).max() or 1.0
    mean_direction = directions.mean(axis=0)
    ahead = mean_direction if np.linalg.norm(mean_direction) > 1e-6 else directions[0]
    return centre + distance * ahead / np.linalg.norm(ahead)
