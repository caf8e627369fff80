"""How near the surfaces are that the ray of a pixel meets: sums over its Gaussians, with gradients.

Of a plane that does not pass through the camera, 1/z is linear in the ray (x/z, y/z, 1). So a
Gaussian is given the plane that rays meet it at, as a vector q with 1/z = q · ray, and what a pixel
needs of ρ_i = q_i · ray is blended like colours: Σ w ρ = (Σ w q) · ray, Σ w ρ² = rayᵀ (Σ w q qᵀ)
ray.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.rasterizer import Geometry, Layer, Projection, rasterize
from mrgs.rasterizer.contract import NEAR_PLANE, STEEPEST_TANGENT
from mrgs.rasterizer.reference import pixel_centres, rotation_matrices, to_camera


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
