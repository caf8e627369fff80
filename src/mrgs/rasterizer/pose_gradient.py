"""The gradient of a camera's pose, from those of the Gaussians that it sees: to turn and move all
alike changes an image as the camera's opposite motion does. No kernel need know of poses."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.scene.rotations import cross_matrix


def with_pose_gradient(
    means: Float[Tensor, "n 3"], quats: Float[Tensor, "n 4"], viewmat: Float64[Tensor, "4 4"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    """The same centres and rotations, whose gradients are also turned into that of a pose.

    The gradient is right for rigid motions: along any path of poses, and of no other matrices.

    Args:
        means: centres in world coordinates that are only seen through ``viewmat``, [N, 3].
        quats: rotations wxyz of these Gaussians, [N, 4].
        viewmat: world to camera, [4, 4]; where it asks for no gradient, nothing is done.
    """
    if not viewmat.requires_grad:
        return means, quats
    found: tuple[Tensor, Tensor] = _PoseGradient.apply(means, quats, viewmat)
    return found


class _PoseGradient(torch.autograd.Function):
    """(means, quats, viewmat) -> means and quats."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, viewmat: Tensor) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(means, quats, viewmat)
        return means.view_as(means), quats.view_as(quats)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_means: Tensor, grad_quats: Tensor) -> tuple[Tensor, ...]:
        means, quats, viewmat = ctx.saved_tensors
        rotation = viewmat[:3, :3]
        # About the camera's centre: about a far origin the sum would lose its digits.
        centre = -rotation.T @ viewmat[:3, 3]
        force = grad_means.sum(dim=0).to(viewmat)
        torque = torch.linalg.cross(means - centre.to(means), grad_means).sum(dim=0)
        w, v, grad_w, grad_v = quats[:, :1], quats[:, 1:], grad_quats[:, :1], grad_quats[:, 1:]
        # By rotation vectors ω, with dq = ½ (0, ω) q.
        turning = w * grad_v - grad_w * v + torch.linalg.cross(v, grad_v)
        torque = torque + 0.5 * turning.sum(dim=0)
        torque = torque.to(viewmat) + torch.linalg.cross(centre, force)
        # The world's motion (ω, τ) changes R by R [ω]× and t by R τ, and the loss by torque · ω +
        # force · τ, which this gradient gives.
        grad = torch.zeros_like(viewmat)
        grad[:3, :3] = 0.5 * rotation @ cross_matrix(torque)
        grad[:3, 3] = rotation @ force
        return grad_means, grad_quats, grad
