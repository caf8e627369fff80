"""Robust bundle adjustment of a rig and of the motions of its pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from mrgs.scene.lens import Lens
from mrgs.scene.rotations import (
    cross_matrix,
    left_jacobian,
    matrix_from_rotvec,
    rigid_transform,
    rotvec_from_matrix,
)

RIG = 12
"""log fx, log(fy / fx), cx, cy (px), k1, k2, rotation vector (rad), translation (scene units)."""

MOTION = 6
"""Rotation vector (radians) and translation (scene units) of a pair, after the rig's."""

LENS = slice(0, 6)
POSE = slice(6, 12)


@dataclass(frozen=True, eq=False)
class ThermalCameras:
    """The parameters of a rig (``RIG``) and of the motions of its pairs (``MOTION``)."""

    rig: Float64[Tensor, "12"]
    motions: Float64[Tensor, "v 6"]

    def lens(self, width: int, height: int) -> Lens:
        """Intrinsics and distortion, for images of this size."""
        log_fx, log_aspect, cx, cy, k1, k2 = self.rig[LENS].tolist()
        fx, fy = math.exp(log_fx), math.exp(log_fx + log_aspect)
        return Lens(width, height, fx, fy, cx, cy, (k1, k2, 0.0, 0.0))

    def extrinsics(self) -> Float64[Tensor, "4 4"]:
        """The rig's rigid motion [4, 4] from the photo's camera to the thermal camera."""
        return rigid_motion(self.rig[POSE])

    def correction(self, view: int) -> Float64[Tensor, "4 4"]:
        """A pair's own rigid motion [4, 4], which follows the rig's."""
        return rigid_motion(self.motions[view])


def lens_parameters(lens: Lens) -> Float64[Tensor, "6"]:
    """The rig's parameters of a lens; higher and tangential distortion are left out."""
    logarithms = math.log(lens.fx), math.log(lens.fy / lens.fx)
    return torch.tensor([*logarithms, lens.cx, lens.cy, *lens.radial[:2]], dtype=torch.float64)


def motion_parameters(matrix: Float64[Tensor, "4 4"]) -> Float64[Tensor, "6"]:
    """Rotation vector and translation of a rigid motion."""
    return torch.cat([torch.from_numpy(rotvec_from_matrix(matrix[:3, :3])), matrix[:3, 3]])


def rigid_motion(parameters: Float64[Tensor, "6"]) -> Float64[Tensor, "4 4"]:
    """The matrix of a rotation vector and a translation."""
    return rigid_transform(matrix_from_rotvec(parameters[:3]), parameters[3:])


def project(
    rig: Float64[Tensor, "12"], motions: Float64[Tensor, "n 6"], points: Float64[Tensor, "n 3"]
) -> Float64[Tensor, "n 2"]:
    """Thermal pixels [N, 2] of points in their photos' cameras, each with its pair's motion."""
    return _project(rig, motions, points)[0]


def project_jacobian(
    rig: Float64[Tensor, "12"], motions: Float64[Tensor, "n 6"], points: Float64[Tensor, "n 3"]
) -> Float64[Tensor, "n 2 18"]:
    """Derivatives of ``project`` with respect to the rig and the motion [N, 2, 18]."""
    _, inside, turned, shifted = _project(rig, motions, points)
    own_rotation = _rotations(motions[:, :3])
    by_lens, by_inside = _lens_jacobian(rig, inside)
    by_place = [
        own_rotation @ -cross_matrix(turned) @ left_jacobian(rig[None, 6:9]),
        own_rotation,
        -cross_matrix(shifted) @ left_jacobian(motions[:, :3]),
        torch.eye(3, dtype=points.dtype).expand(len(points), 3, 3),
    ]
    return torch.cat([by_lens, by_inside @ torch.cat(by_place, dim=2)], dim=2)


def _project(rig: Tensor, motions: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels; points in thermal axes; rotated by the rig; rotated by both, not yet translated."""
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


_STEPS = 12
_MEDIAN_CHI2 = 1.386
"""Median of the squared length of a vector of two independent standard normal numbers."""

_ROBUST_SCALE = 4.0
_INLIER_WEIGHT = 0.25
_LEAST_SIGMA = 1e-9
"""What fixes a parameter."""


@dataclass(frozen=True, eq=False)
class Observations:
    """N patches, or corners of a target, found in both images of the pairs.

    Attributes:
        views: index of the pair.
        points: in the axes of the pair's photo camera.
        pixels: in the thermal image.
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
    """Normal distributions of the rig, and of the motions about zero, before any observation: mean
    and standard deviations, of which 0 fixes a parameter."""

    rig: Float64[Tensor, "12"]
    rig_sigma: Float64[Tensor, "12"]
    motion_sigma: Float64[Tensor, "6"]


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The adjusted cameras; the covariance of the rig's parameters and each pair's motion, with
    overlapping patches taken into account; the residual of each observation; and which of them
    agree with the result."""

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
    """Maximum a posteriori estimate by Gauss-Newton with Geman and McClure's robust weights, scaled
    by the median residual of each kind. How far pairs move at all follows from those that show it,
    within the prior: where shutters fire together, the rig places pairs with few observations."""
    rig, motions, assumed = start.rig, start.motions, prior
    for step in range(_STEPS + 1):
        residual, weight = _weights(observations, rig, motions)
        equations = _normal_equations(observations, residual, weight, rig, motions, assumed)
        if step < _STEPS:
            rig_step, motion_steps = equations.solution()
            rig, motions = rig + rig_step, motions + motion_steps
            spread = _motion_spread(motions, equations.covariances(), prior, assumed)
            assumed = replace(prior, motion_sigma=spread * prior.motion_sigma)
    inlier = weight > _INLIER_WEIGHT * weight.max()
    cameras = ThermalCameras(rig, motions)
    return Adjusted(cameras, equations.covariances(), residual.norm(dim=1), inlier)


def _motion_spread(
    motions: Float64[Tensor, "v 6"], covariances: Tensor, prior: Prior, assumed: Prior
) -> float:
    """The standard deviation of the pairs' motions, as a share of the prior's, at most 1: their
    mean square over the number of parameters that the observations determine (the evidence's
    maximum: D. MacKay, Bayesian Interpolation, 1992), with one parameter's worth of the prior."""
    variances = covariances[:, RIG:, RIG:].diagonal(dim1=1, dim2=2)
    free = prior.motion_sigma > _LEAST_SIGMA
    determined = (1 - variances / assumed.motion_sigma.clamp(min=_LEAST_SIGMA) ** 2)[:, free]
    squares = (motions[:, free] / prior.motion_sigma[free]).square().sum()
    count = determined.clamp(min=0).sum()
    return math.sqrt(min(1.0, float((squares + 1) / (count + 1))))


def pixel_sigma(
    adjusted: Adjusted, view: int, points: Float64[Tensor, "n 3"]
) -> Float64[Tensor, " n"]:
    """Standard deviation, px, of the thermal positions of points in a pair's RGB camera."""
    motions = adjusted.cameras.motions[view].repeat(len(points), 1)
    jacobian = project_jacobian(adjusted.cameras.rig, motions, points)
    variance = torch.einsum("nia,ab,nib->n", jacobian, adjusted.covariance[view], jacobian)
    return variance.clamp(min=0).sqrt()


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


class _NormalEquations(NamedTuple):
    """Gauss-Newton's equations: blocks of the Hessian, and negative gradients. No observation
    depends on the motions of two pairs, so all other blocks are zero, and the motions can be
    eliminated one by one (Schur's complement): work grows with the pairs, not their cube."""

    rig: Float64[Tensor, "12 12"]
    coupling: Float64[Tensor, "v 12 6"]
    motions: Float64[Tensor, "v 6 6"]
    rig_gradient: Float64[Tensor, "12"]
    motion_gradients: Float64[Tensor, "v 6"]

    def solution(self) -> tuple[Float64[Tensor, "12"], Float64[Tensor, "v 6"]]:
        """The steps of the rig and of the motions."""
        reduced, eliminated = self._reduced()
        known = torch.einsum("vij,vj->i", eliminated, self.motion_gradients)
        rig = torch.linalg.solve(reduced, self.rig_gradient - known)
        left = self.motion_gradients - (self.coupling.mT @ rig[:, None])[:, :, 0]
        return rig, torch.linalg.solve(self.motions, left)

    def covariances(self) -> Float64[Tensor, "v 18 18"]:
        """Covariances of the rig's parameters and each pair's motion."""
        reduced, eliminated = self._reduced()
        rig = torch.linalg.inv(reduced)
        mixed = -rig @ eliminated
        motions = torch.linalg.inv(self.motions) - eliminated.mT @ mixed
        above = torch.cat([rig.expand(len(mixed), -1, -1), mixed], dim=2)
        return torch.cat([above, torch.cat([mixed.mT, motions], dim=2)], dim=1)

    def _reduced(self) -> tuple[Float64[Tensor, "12 12"], Float64[Tensor, "v 12 6"]]:
        """The Hessian of the rig without the motions, and the coupling times the inverse of each
        motion's Hessian."""
        eliminated = torch.linalg.solve(self.motions, self.coupling, left=False)
        return self.rig - (eliminated @ self.coupling.mT).sum(dim=0), eliminated


def _normal_equations(
    observations: Observations,
    residual: Float64[Tensor, "n 2"],
    weight: Float64[Tensor, " n"],
    rig: Float64[Tensor, "12"],
    motions: Float64[Tensor, "v 6"],
    prior: Prior,
) -> _NormalEquations:
    count, views = len(motions), observations.views
    information = observations.information * weight[:, None, None]
    jacobian = project_jacobian(rig, motions[views], observations.points)
    blocks = jacobian.new_zeros(count, RIG + MOTION, RIG + MOTION)
    blocks.index_add_(0, views, torch.einsum("nia,nij,njb->nab", jacobian, information, jacobian))
    slopes = jacobian.new_zeros(count, RIG + MOTION)
    slopes.index_add_(0, views, torch.einsum("nia,nij,nj->na", jacobian, information, residual))
    rig_precision, motion_precision = (
        sigma.clamp(min=_LEAST_SIGMA) ** -2 for sigma in (prior.rig_sigma, prior.motion_sigma)
    )
    return _NormalEquations(
        blocks[:, :RIG, :RIG].sum(dim=0) + torch.diag(rig_precision),
        blocks[:, :RIG, RIG:],
        blocks[:, RIG:, RIG:] + torch.diag(motion_precision),
        slopes[:, :RIG].sum(dim=0) + rig_precision * (prior.rig - rig),
        slopes[:, RIG:] - motion_precision * motions,
    )
