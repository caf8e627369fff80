"""Small rigid motions of the world, as a view sees them: what they do to its image tells their
units."""

from __future__ import annotations

import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.rasterizer.reference import rotation_matrices
from mrgs.scene import Camera
from mrgs.scene.rotations import cross_matrix

LEAST_EFFECT = 0.03
"""Motions that shift what a view shows by less than this share of what the most effective one does
count as if they did so much: the photo hardly tells how long they are."""


def shift_per_motion(
    camera: Camera, points: Float64[Tensor, "k 3"], centre: Float64[Tensor, "3"]
) -> Float64[Tensor, "k 2 6"]:
    """J: how points move in the image, in focal lengths, with a small motion of the world.

    Args:
        camera: that sees the points.
        points: in world coordinates.
        centre: about which the world is turned.

    Returns:
        Derivatives of (x/z, y/z) to a rotation vector and a translation.
    """
    viewmat = camera.viewmat.to(points)
    rotation = viewmat[:3, :3]
    turned = -rotation @ cross_matrix(points - centre)
    moved = torch.cat([turned, rotation.expand(len(points), 3, 3)], dim=2)
    x, y, z = (points @ rotation.T + viewmat[:3, 3]).unbind(-1)
    zero = torch.zeros_like(z)
    project = torch.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], dim=-1)
    return project.unflatten(-1, (2, 3)) @ moved


def motion_axes(effects: Float64[Tensor, "*views 6 6"]) -> Float64[Tensor, "*views 6 6"]:
    """Directions in which views tell least to most of a motion, in columns: a coordinate of 1
    shifts what a view shows by a root mean square of a focal length.

    Args:
        effects: of the views, see ``effect``.
    """
    squares, directions = torch.linalg.eigh(effects)
    least = LEAST_EFFECT**2 * squares[..., -1:]
    return directions / squares.clamp_min(least).sqrt()[..., None, :]


def effect(camera: Camera, points: Float64[Tensor, "k 3"]) -> Float64[Tensor, "6 6"]:
    """M, where mᵀ M m is the mean square of the shifts of points in the image, in focal lengths, by
    a small motion m of the world about the camera's centre: a rotation vector and a translation."""
    shifts = shift_per_motion(camera, points, camera.position).flatten(0, 1)
    return shifts.T @ shifts / len(points)


def as_matrix(motion: Float64[Tensor, "6"], centre: Float64[Tensor, "3"]) -> Float64[Tensor, "4 4"]:
    """The motion of the world about a centre, for a camera's ``viewmat`` to be multiplied with.

    Args:
        motion: a rotation vector and a translation, small.
        centre: in world coordinates.
    """
    turn, shift = motion.split(3)
    # About the vector, for small ones; a quaternion has no branch at 0, and never fails.
    rotation = rotation_matrices(torch.cat([turn.new_ones(1), turn / 2])[None])[0]
    moved = torch.cat([rotation, (centre + shift - rotation @ centre)[:, None]], dim=1)
    return torch.cat([moved, torch.eye(4, dtype=moved.dtype, device=moved.device)[3:]])
