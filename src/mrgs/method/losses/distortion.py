"""L_dist: what blocks the light of a pixel lies in one surface. Not in the paper.

The ray of a pixel meets surfaces; what is needed of them are sums over its Gaussians. Of a plane
that does not pass through the camera, 1/z is linear in the ray (x/z, y/z, 1). So a Gaussian is
given the plane that rays meet it at, as a vector q with 1/z = q · ray, and what a pixel needs of
ρ_i = q_i · ray is blended like colours: Σ w ρ = (Σ w q) · ray, Σ w ρ² = rayᵀ (Σ w q qᵀ) ray.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.method.losses.term import LossContext, Term
from mrgs.rasterizer import Geometry, Layer, Projection, rasterize
from mrgs.rasterizer.contract import NEAR_PLANE, STEEPEST_TANGENT
from mrgs.rasterizer.reference import pixel_centres, rotation_matrices, to_camera
from mrgs.scene import THERMAL

BEGINS = 0.3
"""Share of the steps before L_dist, which would hold on to what was not yet seen through
(docs/decisions, 051)."""

EVERY = 8
"""Steps from one use of L_dist to the next, which counts for all of them (docs/decisions, 051)."""

PIXEL_SIZE = 2
"""Side of a pixel in which L_dist is computed, in pixels of the photo."""

LEAST_SPREAD = 1e-3
"""Relative spread of the depths below which a surface is thin enough."""

LARGE_SPREAD = 0.1
"""Relative spread from which on a pixel is taken to see several objects, as along an outline, and
hardly counts more the farther apart they are."""

LEAST_WEIGHT = 0.05
"""Σ w below which a pixel hardly shows a surface."""

LEAST_NEARNESS = 1e-6


class Distortion(Term):
    """L_dist, by the camera of the view that has the finest pixels, from the step
    ``begins`` on; seldom and in coarser pixels, which costs less and does as much."""

    name = "distortion"

    def __init__(self, weight: float, begins: int) -> None:
        self._weight, self._begins = weight, begins

    def is_due(self, step: int) -> bool:  # noqa: D102
        return step >= self._begins and step % EVERY == 0

    def weight(self, step: int) -> float:  # noqa: D102
        return EVERY * self._weight

    def value(self, context: LossContext) -> Float[Tensor, ""] | None:  # noqa: D102
        cameras, gaussians = context.cameras, context.gaussians
        modality = max(cameras, key=lambda each: (cameras[each].focal_px, each == THERMAL))
        camera = cameras[modality]
        width, height = (max(1, side // PIXEL_SIZE) for side in (camera.width, camera.height))
        coarse = camera.resized(width, height)
        projection = context.dilation.projection(coarse, gaussians.means.device)
        opacity = gaussians.opacity(modality)
        return distortion_loss(inverse_depths(Geometry.of(gaussians), opacity, projection))


def distortion_loss(depths: InverseDepths) -> Float[Tensor, ""]:
    """L_dist: how far apart, relative to their distance, the surfaces are that one pixel sees.

    The mean over the pixels of s / (1 + s / 0.1) with the spread s = √(V / ρ̄² + 0.001²), where V =
    Σw Σwρ² − (Σwρ)² = ½ Σ_ij w_i w_j (ρ_i − ρ_j)² is the variance of the inverse depths ρ at which
    the pixel's ray meets its Gaussians, and ρ̄ their mean, without gradient. Mip-NeRF 360 (Barron
    et al. 2022) and 2DGS (Huang et al. 2024) have such a loss of the depths of samples and of
    discs. A plane costs nothing, whatever the angle at which it is seen; a wall that is a slab of
    half-transparent Gaussians does, and so does what floats before it. A pixel that rightly sees
    two objects counts little.
    """
    variance = (depths.weight * depths.squares - depths.sum**2).clamp_min(0)
    mean = (depths.sum / depths.weight.clamp_min(LEAST_WEIGHT)).detach()
    relative = variance / mean.clamp_min(LEAST_NEARNESS) ** 2
    spread = (relative + LEAST_SPREAD**2).sqrt()
    return (spread / (1 + spread / LARGE_SPREAD)).mean()


class InverseDepths(NamedTuple):
    """What a pixel's ray meets; w are the weights of the Gaussians in the image, ρ = 1/z where the
    ray meets them. Σ w is the accumulated alpha, ``sum`` Σ w ρ and ``squares`` Σ w ρ²."""

    weight: Float[Tensor, "h w"]
    sum: Float[Tensor, "h w"]
    squares: Float[Tensor, "h w"]


def inverse_depths(
    geometry: Geometry, opacities: Float[Tensor, " n"], projection: Projection
) -> InverseDepths:
    """The sums of the inverse depths of a layer with these opacities, in three passes of the
    rasterizer, for nine channels; differentiable in the geometry and the opacities."""
    projection = projection.to(opacities)

    def blended(*features: Tensor) -> list[Tensor]:
        layers = [Layer(opacities, each, opacities.new_zeros(each.shape[1])) for each in features]
        blends = rasterize(geometry, layers, projection).blends
        return [blends[0].alpha, *(plane for blend in blends for plane in blend.image.unbind(-1))]

    planes = surface_planes(geometry, projection)
    x, y, z = planes.unbind(-1)
    weight, *sums, xx = blended(planes, (x * x)[:, None])
    _, xy, xz, yy, yz = blended(torch.stack([x * y, x * z, y * y], dim=1), (y * z)[:, None])
    _, zz = blended((z * z)[:, None])

    ray_x, ray_y = ray_directions(projection.K, projection.width, projection.height)
    sum_x, sum_y, sum_z = sums
    return InverseDepths(
        weight,
        sum_x * ray_x + sum_y * ray_y + sum_z,
        xx * ray_x**2 + yy * ray_y**2 + zz + 2 * (xy * ray_x * ray_y + xz * ray_x + yz * ray_y),
    )


def surface_planes(geometry: Geometry, projection: Projection) -> Float[Tensor, "n 3"]:
    """q of each Gaussian: the ray (x/z, y/z, 1) meets it at the depth 1 / (q · ray). The densest
    point of a ray has, to first order about the centre m in camera coordinates, q = Σ⁻¹ m / mᵀ Σ⁻¹
    m: of a disc its own plane. Σ is dilated as in the image, or needles would be steep planes; none
    is steeper than ``contract.STEEPEST_TANGENT``."""
    (means, quats, scales), (viewmat, K, _, _, dilation_px2) = geometry, projection
    camera = to_camera(means, viewmat)
    z = camera[:, 2:].clamp_min(NEAR_PLANE)
    centres = torch.cat([camera[:, :2], z], dim=1)
    axes = viewmat[:3, :3] @ rotation_matrices(quats)
    pixel2 = dilation_px2 * z**2 / (K[0, 0] * K[1, 1])
    # In the axes of the Gaussian, whose Σ is diagonal there.
    along_axes = (axes * centres[:, :, None]).sum(dim=1)
    weighed = along_axes / (scales**2 + pixel2)
    normals = (axes * weighed[:, None, :]).sum(dim=2)
    planes = normals / (along_axes * weighed).sum(dim=1, keepdim=True)
    across = (planes[:, :2] * z).clamp(-STEEPEST_TANGENT, STEEPEST_TANGENT) / z
    # Whatever the slope, the centre keeps its depth.
    along = (1 - (across * centres[:, :2]).sum(dim=1, keepdim=True)) / z
    return torch.cat([across, along], dim=1)


def ray_directions(
    K: Float[Tensor, "3 3"], width: int, height: int
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """x/z and y/z of every pixel's ray."""
    directions = (pixel_centres(width, height, K) - K[:2, 2]) / K.diagonal()[:2]
    x, y = directions.unflatten(0, (height, width)).unbind(-1)
    return x, y
