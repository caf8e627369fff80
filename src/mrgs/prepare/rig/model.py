"""The thermal camera as a function of its parameters: a rig that all pairs share, and a small
motion of each pair."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.data.lens import Lens
from mrgs.scene.rotations import (
    cross_matrix,
    left_jacobian,
    matrix_from_rotvec,
    rigid_transform,
    rotvec_from_matrix,
)

RIG = 12
"""log fx, log(fy / fx), cx, cy (thermal pixels), k1, k2, rotation vector (radians), translation
(scene units)."""

MOTION = 6
"""Rotation vector (radians) and translation (scene units) of a pair, after the rig's."""

LENS = slice(0, 6)
POSE = slice(6, 12)


@dataclass(frozen=True, eq=False)
class ThermalCameras:
    """The parameters of a rig and of the motions of its pairs.

    Attributes:
        rig: [12], see ``RIG``.
        motions: [V, 6], see ``MOTION``.
    """

    rig: Float64[Tensor, "12"]
    motions: Float64[Tensor, "v 6"]

    def lens(self, width: int, height: int) -> Lens:
        """Intrinsics and distortion, for images of this size."""
        log_fx, log_aspect, cx, cy, k1, k2 = self.rig[LENS].tolist()
        fx, fy = torch.tensor([log_fx, log_fx + log_aspect], dtype=torch.float64).exp().tolist()
        return Lens(width, height, fx, fy, cx, cy, (k1, k2, 0.0, 0.0))

    def extrinsics(self) -> Float64[Tensor, "4 4"]:
        """The rig's rigid motion [4, 4] from the photo's camera to the thermal camera."""
        return rigid_motion(self.rig[POSE])

    def correction(self, view: int) -> Float64[Tensor, "4 4"]:
        """A pair's own rigid motion [4, 4], which follows the rig's."""
        return rigid_motion(self.motions[view])


def lens_parameters(lens: Lens) -> Float64[Tensor, "6"]:
    """The rig's parameters of a lens; higher and tangential distortion are left out."""
    numbers = torch.tensor(
        [lens.fx, lens.fy / lens.fx, lens.cx, lens.cy, *lens.radial[:2]], dtype=torch.float64
    )
    numbers[:2] = numbers[:2].log()
    return numbers


def motion_parameters(matrix: Float64[Tensor, "4 4"]) -> Float64[Tensor, "6"]:
    """Rotation vector and translation of a rigid motion."""
    return torch.cat([torch.from_numpy(rotvec_from_matrix(matrix[:3, :3])), matrix[:3, 3]])


def rigid_motion(parameters: Float64[Tensor, "6"]) -> Float64[Tensor, "4 4"]:
    """The matrix of a rotation vector and a translation."""
    return rigid_transform(matrix_from_rotvec(parameters[:3]), parameters[3:])


def project(
    rig: Float64[Tensor, "12"], motions: Float64[Tensor, "n 6"], points: Float64[Tensor, "n 3"]
) -> Float64[Tensor, "n 2"]:
    """Thermal pixel positions [N, 2] of points in the axes of their photos' cameras, each with its
    pair's motion."""
    return _project(rig, motions, points)[0]


def project_jacobian(
    rig: Float64[Tensor, "12"], motions: Float64[Tensor, "n 6"], points: Float64[Tensor, "n 3"]
) -> Float64[Tensor, "n 2 18"]:
    """Derivatives of ``project`` with respect to the rig and the motion [N, 2, 18]."""
    _, inside, turned, shifted = _project(rig, motions, points)
    own_rotation = _rotations(motions[:, :3])
    by_lens, by_inside = _lens_jacobian(rig, inside)
    by_motion = [
        -cross_matrix(shifted) @ left_jacobian(motions[:, :3]),
        torch.eye(3, dtype=points.dtype).expand(len(points), 3, 3),
    ]
    by_rotvec = own_rotation @ -cross_matrix(turned) @ left_jacobian(rig[None, 6:9])
    by_pose = [by_rotvec, own_rotation]
    return torch.cat([by_lens, by_inside @ torch.cat(by_pose + by_motion, dim=2)], dim=2)


def _project(rig: Tensor, motions: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels; the points in thermal axes; rotated by the rig alone; and rotated by both, before the
    last translation."""
    turned = points @ _rotations(rig[None, 6:9])[0].T
    shifted = torch.einsum("nij,nj->ni", _rotations(motions[:, :3]), turned + rig[9:12])
    inside = shifted + motions[:, 3:]
    slopes = inside[:, :2] / inside[:, 2:]
    r2 = slopes.square().sum(dim=1, keepdim=True)
    focal = torch.stack([rig[0], rig[0] + rig[1]]).exp()
    pixels = focal * (1 + r2 * (rig[4] + r2 * rig[5])) * slopes + rig[2:4]
    return pixels, inside, turned, shifted


def _lens_jacobian(rig: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the pixels by the lens's parameters [n, 2, 6], and by the point in thermal
    axes [n, 2, 3]."""
    slopes, depth = inside[:, :2] / inside[:, 2:], inside[:, 2:]
    r2 = slopes.square().sum(dim=1, keepdim=True)
    focal = torch.stack([rig[0], rig[0] + rig[1]]).exp()
    scale, bend = 1 + r2 * (rig[4] + r2 * rig[5]), rig[4] + 2 * r2 * rig[5]
    offset = focal * scale * slopes
    by_lens = torch.zeros(len(inside), 2, 6, dtype=inside.dtype)
    by_lens[:, :, 0] = offset
    by_lens[:, 1, 1] = offset[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    by_lens[:, :, 4], by_lens[:, :, 5] = focal * r2 * slopes, focal * r2.square() * slopes
    by_slopes = (
        scale[:, :, None] * torch.eye(2)
        + 2 * bend[:, :, None] * slopes[:, :, None] * slopes[:, None, :]
    )
    by_point = (
        torch.cat([torch.eye(2).expand(len(inside), 2, 2), -slopes[:, :, None]], dim=2)
        / depth[:, :, None]
    )
    return by_lens, focal[:, None] * (by_slopes @ by_point)


def _rotations(rotvec: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3 3"]:
    return torch.from_numpy(matrix_from_rotvec(rotvec))
