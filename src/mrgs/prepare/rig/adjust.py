"""Robust bundle adjustment of a rig and of the motions of its pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from mrgs.prepare.rig.model import MOTION, RIG, ThermalCameras, project, project_jacobian

_STEPS = 12
_MEDIAN_CHI2 = 1.386
"""Median of the squared length of a vector of two independent standard normal numbers."""

_ROBUST_SCALE = 4.0
_INLIER_WEIGHT = 0.25


@dataclass(frozen=True, eq=False)
class Observations:
    """N patches, or corners of a target, found in both images of the pairs.

    Attributes:
        views: index of the pair.
        points: observed points in the axes of the pair's photo camera.
        pixels: their positions in the thermal image.
        information: inverse covariance of ``pixels``, up to a factor for each kind.
        independent: share of each observation that is statistically independent: overlapping
            patches share their errors.
        kinds: 0, 1, ...; each kind has a noise scale of its own.
    """

    views: Int64[Tensor, " n"]
    points: Float64[Tensor, "n 3"]
    pixels: Float64[Tensor, "n 2"]
    information: Float64[Tensor, "n 2 2"]
    independent: Float64[Tensor, " n"]
    kinds: Int64[Tensor, " n"]

    @classmethod
    def joined(cls, parts: Sequence[Observations]) -> Observations:
        """The observations of several parts, in their order."""
        return cls(*(torch.cat([getattr(p, each.name) for p in parts]) for each in fields(cls)))


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal distributions of the rig, and of the motions about zero, before any observation.

    Attributes:
        rig: mean of the rig's parameters.
        rig_sigma: standard deviations; 0 fixes a parameter.
        motion_sigma: standard deviations of each pair's motion.
    """

    rig: Float64[Tensor, "12"]
    rig_sigma: Float64[Tensor, "12"]
    motion_sigma: Float64[Tensor, "6"]


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The adjusted cameras, their covariance and the residuals.

    Attributes:
        cameras: the rig and the motions.
        covariance: of the rig's parameters and each pair's motion [V, 18, 18], with overlapping
            patches taken into account.
        residual_px: of each observation [N].
        inlier: mask of the observations that agree with the result [N].
    """

    cameras: ThermalCameras
    covariance: Float64[Tensor, "v 18 18"]
    residual_px: Float64[Tensor, " n"]
    inlier: Tensor


def aimed(cameras: ThermalCameras, observations: Observations) -> ThermalCameras:
    """The cameras after a rotation of each that makes its mean residual vanish, to first order."""
    motions = cameras.motions.clone()
    pixels = project(cameras.rig, motions[observations.views], observations.points)
    for view in observations.views.unique():
        right, down = (observations.pixels - pixels)[observations.views == view].mean(dim=0)
        motions[view, :2] += torch.stack([-down, right]) / cameras.rig[0].exp()
    return ThermalCameras(cameras.rig, motions)


def adjust(observations: Observations, prior: Prior, start: ThermalCameras) -> Adjusted:
    """Maximum a posteriori estimate by Gauss-Newton with Geman and McClure's robust weights.

    The scale of the weights follows from the median residual of each kind.
    """
    rig, motions = start.rig, start.motions
    for _ in range(_STEPS):
        residual, weight = _weights(observations, rig, motions)
        hessian, gradient = _normal_equations(observations, residual, weight, rig, motions, prior)
        step = torch.linalg.solve(hessian, gradient)
        rig, motions = rig + step[:RIG], motions + step[RIG:].reshape(-1, MOTION)
    residual, weight = _weights(observations, rig, motions)
    hessian, _ = _normal_equations(observations, residual, weight, rig, motions, prior)
    return Adjusted(
        ThermalCameras(rig, motions),
        _covariances(hessian, len(motions)),
        residual.norm(dim=1),
        weight > _INLIER_WEIGHT * weight.max(),
    )


def pixel_sigma(
    adjusted: Adjusted, view: int, points: Float64[Tensor, "n 3"]
) -> Float64[Tensor, " n"]:
    """Standard deviation, in pixels, of the thermal positions of points in a pair's RGB camera
    axes."""
    motions = adjusted.cameras.motions[view].repeat(len(points), 1)
    jacobian = project_jacobian(adjusted.cameras.rig, motions, points)
    return (
        torch.einsum("nia,ab,nib->n", jacobian, adjusted.covariance[view], jacobian)
        .clamp(min=0)
        .sqrt()
    )


def _weights(
    observations: Observations, rig: Float64[Tensor, "12"], motions: Float64[Tensor, "v 6"]
) -> tuple[Tensor, Tensor]:
    """Residuals [N, 2], and the factors of the observations' information [N]."""
    residual = observations.pixels - project(rig, motions[observations.views], observations.points)
    squared = torch.einsum("ni,nij,nj->n", residual, observations.information, residual)
    scale = torch.ones_like(squared)
    for kind in observations.kinds.unique():
        own = observations.kinds == kind
        scale[own] = squared[own].median() / _MEDIAN_CHI2 + 1e-12
    robust = (1 + squared / (_ROBUST_SCALE * scale)) ** -2
    return residual, robust * observations.independent / scale


def _normal_equations(
    observations: Observations,
    residual: Float64[Tensor, "n 2"],
    weight: Float64[Tensor, " n"],
    rig: Float64[Tensor, "12"],
    motions: Float64[Tensor, "v 6"],
    prior: Prior,
) -> tuple[Tensor, Tensor]:
    """Hessian and negative gradient over the rig's parameters, followed by each pair's."""
    count, views = len(motions), observations.views
    information = observations.information * weight[:, None, None]
    jacobian = project_jacobian(rig, motions[views], observations.points)
    blocks = jacobian.new_zeros(count, RIG + MOTION, RIG + MOTION)
    blocks.index_add_(0, views, torch.einsum("nia,nij,njb->nab", jacobian, information, jacobian))
    slopes = jacobian.new_zeros(count, RIG + MOTION)
    slopes.index_add_(0, views, torch.einsum("nia,nij,nj->na", jacobian, information, residual))
    hessian = jacobian.new_zeros(RIG + MOTION * count, RIG + MOTION * count)
    hessian[:RIG, :RIG] = blocks[:, :RIG, :RIG].sum(dim=0)
    for view, block in enumerate(blocks):
        own = slice(RIG + MOTION * view, RIG + MOTION * (view + 1))
        hessian[:RIG, own], hessian[own, :RIG], hessian[own, own] = (
            block[:RIG, RIG:],
            block[RIG:, :RIG],
            block[RIG:, RIG:],
        )
    precision = torch.cat([prior.rig_sigma, prior.motion_sigma.repeat(count)]).clamp(min=1e-9) ** -2
    error = torch.cat([prior.rig - rig, -motions.flatten()])
    gradient = torch.cat([slopes[:, :RIG].sum(dim=0), slopes[:, RIG:].flatten()])
    return hessian + torch.diag(precision), gradient + precision * error


def _covariances(hessian: Tensor, count: int) -> Float64[Tensor, "v 18 18"]:
    covariance = torch.linalg.inv(hessian)
    chosen = [
        torch.cat([torch.arange(RIG), torch.arange(RIG + MOTION * view, RIG + MOTION * (view + 1))])
        for view in range(count)
    ]
    return torch.stack([covariance[index][:, index] for index in chosen])
