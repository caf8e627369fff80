"""The oracle: the image model of ``contract.py`` in plain torch, one function per equation, any
dtype and device.

It is written to be read and to be right, not to be fast, and shares no code with the kernels.
Gradients come from autograd. Shapes: N Gaussians given, M of them in front of the camera, P pixels,
C channels.

Sources: 3D Gaussian Splatting (Kerbl et al. 2023) for Σ = R S Sᵀ Rᵀ and the blending; EWA Splatting
(Zwicker et al. 2001) for the projection of the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.rasterizer.contract import (
    ALPHA_MAX,
    ALPHA_MIN,
    FRUSTUM_MARGIN,
    NEAR_PLANE,
    STEEPEST,
    SURFACE_TRANSMITTANCES,
    TRANSMITTANCE_MIN,
    Blend,
    Geometry,
    Layer,
    Projection,
    Raster,
)

CHUNK_ELEMENTS = 2**20
"""Most (pixel, Gaussian) pairs that are blended at once: bounds the memory, not the result."""


class Splats(NamedTuple):
    """The Gaussians in front of the camera, projected, nearest first.

    Attributes:
        indices: their rows in the rasterizer's inputs, [M].
        means2d: projected centres μ' in pixels, [M, 2].
        covs2d: projected, dilated covariances Σ' in px², [M, 2, 2].
        depths: z in camera coordinates, scene units, [M].
    """

    indices: Tensor
    means2d: Tensor
    covs2d: Tensor
    depths: Tensor


def rasterize(
    geometry: Geometry,
    layers: Sequence[Layer],
    projection: Projection,
    means2d_offset: Float[Tensor, "n 2"] | None = None,
) -> Raster:
    """Render the layers from one camera; differentiable in the geometry, ``means2d_offset`` and
    every tensor of every layer. ValueError if a shape does not fit, there is not one or two layers,
    or the image has no pixels.

    Args:
        layers: one layer, or two that share the walk over the Gaussians.
        projection: of the camera, of any dtype and on any device; no gradient flows to it.
        means2d_offset: added to the projected centres, in pixels, [N, 2]; its gradient is the
            screen-space gradient that densification reads.
    """
    _check_shapes(geometry, layers, projection, means2d_offset)
    means, projection = geometry.means, projection.to(geometry.means)
    width, height = projection.width, projection.height
    splats = project(geometry, projection, means2d_offset)
    opacities = [layer.opacities[splats.indices] for layer in layers]
    radii = torch.zeros_like(means[:, 0]).index_put(
        (splats.indices,), extents_px(splats, opacities, width, height)
    )
    layer_tensors = [
        tensor
        for layer, opacity in zip(layers, opacities, strict=True)
        for tensor in (opacity, layer.features[splats.indices], layer.background)
    ]
    pixels = pixel_centres(width, height, means)
    images = _BlendInChunks.apply(
        pixels, splats.means2d, splats.covs2d, splats.depths, *layer_tensors
    )
    images = [image.unflatten(0, (height, width)) for image in images]
    return Raster(tuple(Blend(*images[i : i + 3]) for i in range(0, len(images), 3)), radii)


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """R of the quaternions wxyz, which are normalised first."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def covariances(
    quats: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3 3"]:
    """Σ = R S Sᵀ Rᵀ in world coordinates."""
    rotated_axes = rotation_matrices(quats) * scales[:, None, :]
    return rotated_axes @ rotated_axes.mT


def to_camera(means: Float[Tensor, "n 3"], viewmat: Float[Tensor, "4 4"]) -> Float[Tensor, "n 3"]:
    """μ in camera coordinates: R_w μ + t."""
    return means @ viewmat[:3, :3].T + viewmat[:3, 3]


def perspective(
    means_camera: Float[Tensor, "n 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "n 2"]:
    """μ' = (fx x/z + cx, fy y/z + cy) in pixels."""
    focal, principal_point = K.diagonal()[:2], K[:2, 2]
    return focal * means_camera[:, :2] / means_camera[:, 2:] + principal_point


def jacobians(
    means_camera: Float[Tensor, "n 3"], K: Float[Tensor, "3 3"], width: int, height: int
) -> Float[Tensor, "n 2 3"]:
    """J = [[fx/z, 0, −fx u/z], [0, fy/z, −fy v/z]], the derivative of the perspective projection;
    (u, v) = (x/z, y/z), clamped to the image widened by FRUSTUM_MARGIN half fields of view on each
    side, beyond which Gaussians would be stretched without bound."""
    focal, principal_point = K.diagonal()[:2], K[:2, 2]
    size = K.new_tensor([width, height])
    margin = FRUSTUM_MARGIN * size / (2 * focal)
    lower, upper = -principal_point / focal - margin, (size - principal_point) / focal + margin
    directions = (means_camera[:, :2] / means_camera[:, 2:]).clamp(lower, upper)
    focal_over_depth = focal / means_camera[:, 2:]
    return torch.cat(
        [torch.diag_embed(focal_over_depth), -(focal_over_depth * directions)[:, :, None]], dim=2
    )


def project_covariances(
    covs: Float[Tensor, "n 3 3"],
    jacobian: Float[Tensor, "n 2 3"],
    viewmat: Float[Tensor, "4 4"],
    dilation_px2: float,
) -> Float[Tensor, "n 2 2"]:
    """Σ' = J R_w Σ R_wᵀ Jᵀ + d I in px²."""
    world_to_image = jacobian @ viewmat[:3, :3]
    dilation = dilation_px2 * torch.eye(2, dtype=covs.dtype, device=covs.device)
    return world_to_image @ covs @ world_to_image.mT + dilation


def depth_slopes(
    covs: Float[Tensor, "n 3 3"],
    jacobian: Float[Tensor, "n 2 3"],
    covs2d: Float[Tensor, "n 2 2"],
    viewmat: Float[Tensor, "4 4"],
) -> Float[Tensor, "n 2"]:
    """∂z/∂x' = Σ'⁻¹ J R_w Σ r in scene units per pixel, r the last row of R_w: the slope of a
    Gaussian's mean z given x', as a disc that is seen obliquely is nearer on one side."""
    with_depth = (jacobian @ viewmat[:3, :3] @ covs @ viewmat[2, :3, None]).squeeze(-1)
    return torch.linalg.solve(covs2d, with_depth)


def project(
    geometry: Geometry, projection: Projection, means2d_offset: Float[Tensor, "n 2"] | None = None
) -> Splats:
    """Drop what lies before the near plane or reaches the plane of the camera, sort the rest by
    distance from the camera's centre (ties by index) and project it."""
    viewmat, K, width, height, dilation_px2 = projection
    means_camera = to_camera(geometry.means, viewmat)
    covs = covariances(geometry.quats, geometry.scales)
    z, depth_variances = means_camera[:, 2], viewmat[2, :3] @ covs @ viewmat[2, :3]
    in_front = torch.nonzero((z >= NEAR_PLANE) & (depth_variances <= z**2)).squeeze(1)
    indices = in_front[torch.argsort(means_camera[in_front].norm(dim=1), stable=True)]
    means_camera, covs = means_camera[indices], covs[indices]
    means2d = perspective(means_camera, K)
    if means2d_offset is not None:
        means2d = means2d + means2d_offset[indices]
    jacobian = jacobians(means_camera, K, width, height)
    covs2d = project_covariances(covs, jacobian, viewmat, dilation_px2)
    return Splats(indices, means2d, covs2d, means_camera[:, 2])


def pixel_centres(width: int, height: int, like: Tensor) -> Float[Tensor, "p 2"]:
    """x' of every pixel, (column + 0.5, row + 0.5), row by row; dtype and device of ``like``."""
    columns, rows = (
        torch.arange(size, dtype=like.dtype, device=like.device) + 0.5 for size in (width, height)
    )
    return torch.cartesian_prod(rows, columns).flip(-1)


def falloffs(
    pixels: Float[Tensor, "p 2"], means2d: Float[Tensor, "m 2"], covs2d: Float[Tensor, "m 2 2"]
) -> Float[Tensor, "p m"]:
    """exp(−½ (x' − μ')ᵀ Σ'⁻¹ (x' − μ')) of every pixel and Gaussian."""
    dx, dy = (pixels[:, None] - means2d).unbind(-1)
    a, b, c = covs2d[:, 0, 0], covs2d[:, 0, 1], covs2d[:, 1, 1]
    return torch.exp(-(c * dx**2 - 2 * b * dx * dy + a * dy**2) / (2 * (a * c - b**2)))


def alphas(opacities: Float[Tensor, " m"], falloff: Float[Tensor, "p m"]) -> Float[Tensor, "p m"]:
    """α = min(0.999, o · falloff), 0 where that is below 1/255; no gradient at either bound."""
    alpha = (opacities * falloff).clamp(max=ALPHA_MAX)
    return torch.where(alpha >= ALPHA_MIN, alpha, 0.0)


def transmittances(alpha: Float[Tensor, "p m"]) -> Float[Tensor, "p m+1"]:
    """T_i = Π_{j<i} (1 − α_j): what reaches the Gaussian i, and at the end what passes them all."""
    ones = alpha.new_ones(len(alpha), 1)
    return torch.cat([ones, 1 - alpha], dim=1).cumprod(dim=1)


def unfinished(alpha: Float[Tensor, "p m"]) -> Bool[Tensor, "p m"]:
    """Whether T_i >= 1e-4 at the turn of Gaussian i; the one that brings T below still counts."""
    return transmittances(alpha.detach())[:, :-1] >= TRANSMITTANCE_MIN


def blend(
    falloff: Float[Tensor, "p m"], depths: Float[Tensor, " m"], layer: Layer
) -> tuple[Tensor, Tensor, Tensor]:
    """Σ w f + T_end · background [P, C], Σ w z [P] and 1 − T_end [P] of one (sorted) layer, with w
    = α T."""
    alpha = alphas(layer.opacities, falloff)
    alpha = torch.where(unfinished(alpha), alpha, 0.0)
    transmittance = transmittances(alpha)
    weights, passed = alpha * transmittance[:, :-1], transmittance[:, -1]
    return (
        weights @ layer.features + passed[:, None] * layer.background,
        weights @ depths,
        1 - passed,
    )


@torch.no_grad()
def median_depth(
    geometry: Geometry, opacities: Float[Tensor, " n"], projection: Projection
) -> Float[Tensor, "h w"]:
    """z at which a layer's transmittance T falls to one half, scene units, [H, W]; NaN where more
    than half passes all Gaussians; no gradients. It is the mean over what brings T from 0.6 to 0.4,
    mostly one Gaussian or two, of z on the pixel's ray; Σ w z would lie between two surfaces
    wherever a little of the farther one, or fog, shows. Opacities are those of the layer, in (0,
    1), [N]."""
    means, quats, scales = geometry
    projection = projection.to(means)
    viewmat, K, width, height, _ = projection
    splats = project(geometry, projection)
    if len(splats.indices) == 0:
        return means.new_full((height, width), torch.nan)
    covs = covariances(quats, scales)[splats.indices]
    jacobian = jacobians(to_camera(means, viewmat)[splats.indices], K, width, height)
    slopes = depth_slopes(covs, jacobian, splats.covs2d, viewmat)
    pixels = pixel_centres(width, height, means)
    chunks = pixels.split(max(1, CHUNK_ELEMENTS // len(splats.indices)))
    opacities = opacities[splats.indices]
    medians = [
        surface_depths(
            depths_along_rays(chunk, splats, slopes),
            transmittances(alphas(opacities, falloffs(chunk, splats.means2d, splats.covs2d))),
        )
        for chunk in chunks
    ]
    return torch.cat(medians).view(height, width)


def depth_quantiles(depth: Float[Tensor, "h w"], *arguments: Any) -> Float[Tensor, " q"]:
    """What a check compares of a median depth: its quartiles. A single pixel jumps from surface to
    surface where T comes close to one half."""
    del arguments
    known = depth[~depth.isnan()].sort().values
    quarters = [len(known) * k // 4 for k in (1, 2, 3)] if len(known) else []
    return known[quarters]


def depths_along_rays(
    pixels: Float[Tensor, "p 2"], splats: Splats, slopes: Float[Tensor, "m 2"]
) -> Float[Tensor, "p m"]:
    """z where the ray of every pixel meets every Gaussian, flat ones being planes: 1/z is linear in
    x', so that z = z₀ / (1 − ∂z/∂x' (x' − μ') / z₀), with z₀ that of the centre; at most
    ``STEEPEST`` times z₀."""
    offsets = pixels[:, None] - splats.means2d
    nearness = 1 - (offsets * slopes).sum(dim=-1) / splats.depths
    return splats.depths / nearness.clamp_min(1 / STEEPEST)


def surface_depths(
    depths: Float[Tensor, "p m"], transmittance: Float[Tensor, "p m+1"]
) -> Float[Tensor, " p"]:
    """Mean depth of what brings T from the first to the second of ``SURFACE_TRANSMITTANCES``; NaN
    where T ends above one half."""
    begins, ends = SURFACE_TRANSMITTANCES
    shares = -transmittance.clamp(ends, begins).diff(dim=1)
    depth = (shares * depths).sum(dim=1) / shares.sum(dim=1)
    return torch.where(transmittance[:, -1] <= 0.5, depth, torch.nan)


@torch.no_grad()
def extents_px(
    splats: Splats, opacities: Sequence[Float[Tensor, " m"]], width: int, height: int
) -> Float[Tensor, " m"]:
    """The radii of ``contract.Raster``: how far along its longest axis a splat's largest α reaches
    1/255, at τ standard deviations, τ² = 2 ln(255 o). 0 if no pixel can see it: not projected, o <
    1/255, or its ellipse's bounding box misses the image [0, width] × [0, height]."""
    max_opacity = torch.stack(list(opacities)).amax(dim=0)
    tau_squared = (2 * torch.log(max_opacity / ALPHA_MIN)).clamp(min=0)
    half_box = (tau_squared[:, None] * splats.covs2d.diagonal(dim1=1, dim2=2)).sqrt()
    size = half_box.new_tensor([width, height])
    overlaps = ((splats.means2d + half_box >= 0) & (splats.means2d - half_box <= size)).all(dim=1)
    a, b, c = splats.covs2d[:, 0, 0], splats.covs2d[:, 0, 1], splats.covs2d[:, 1, 1]
    largest_eigenvalue = (a + c) / 2 + torch.hypot((a - c) / 2, b)
    return torch.where(overlaps, (tau_squared * largest_eigenvalue).sqrt(), 0.0)


def _blend_layers(
    pixels: Tensor, means2d: Tensor, covs2d: Tensor, depths: Tensor, *layers: Tensor
) -> list[Tensor]:
    """``blend`` of every layer, tensors and results in flat lists, as autograd.Function wants."""
    falloff = falloffs(pixels, means2d, covs2d)
    return [
        image
        for i in range(0, len(layers), 3)
        for image in blend(falloff, depths, Layer(*layers[i : i + 3]))
    ]


class _BlendInChunks(torch.autograd.Function):
    """``_blend_layers`` in chunks; backward blends each again: only one is ever in memory."""

    @staticmethod
    def forward(ctx: Any, pixels: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(pixels, *tensors)
        ctx.pixels_per_chunk = max(1, CHUNK_ELEMENTS // max(1, len(tensors[0])))
        chunks = [_blend_layers(chunk, *tensors) for chunk in pixels.split(ctx.pixels_per_chunk)]
        return tuple(torch.cat(parts) for parts in zip(*chunks, strict=True))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        pixels, *tensors = ctx.saved_tensors
        leaves = [tensor.detach().requires_grad_() for tensor in tensors]
        for chunk, *chunk_cotangents in zip(
            *(t.split(ctx.pixels_per_chunk) for t in (pixels, *cotangents)), strict=True
        ):
            with torch.enable_grad():
                images = _blend_layers(chunk, *leaves)
            torch.autograd.backward(images, chunk_cotangents)
        return None, *(leaf.grad for leaf in leaves)


def _check_shapes(
    geometry: Geometry,
    layers: Sequence[Layer],
    projection: Projection,
    means2d_offset: Tensor | None,
) -> None:
    """Raise ValueError, naming the tensor and both shapes, where one does not fit."""
    if len(layers) not in (1, 2):
        raise ValueError(f"there must be one layer or two, got {len(layers)}")
    width, height, n = projection.width, projection.height, len(geometry.means)
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be at least 1 pixel, got {width} x {height}")
    checks: list[tuple[str, Tensor, tuple[int, ...]]] = [
        ("means", geometry.means, (n, 3)), ("quats", geometry.quats, (n, 4)),
        ("scales", geometry.scales, (n, 3)),
        ("viewmat", projection.viewmat, (4, 4)), ("K", projection.K, (3, 3)),
    ]  # fmt: skip
    if means2d_offset is not None:
        checks.append(("means2d_offset", means2d_offset, (n, 2)))
    for i, layer in enumerate(layers):
        channels = layer.features.shape[-1]
        checks.append((f"layers[{i}].opacities", layer.opacities, (n,)))
        checks.append((f"layers[{i}].features", layer.features, (n, channels)))
        checks.append((f"layers[{i}].background", layer.background, (channels,)))
    for name, tensor, shape in checks:
        if tensor.shape != shape:
            raise ValueError(f"{name} must have the shape {list(shape)}, got {list(tensor.shape)}")
