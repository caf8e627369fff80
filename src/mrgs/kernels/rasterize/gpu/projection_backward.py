"""Backward of the projection, one thread per Gaussian: from the sums of its gradient moments to its
parameters."""

from __future__ import annotations

import triton
import triton.language as tl

from mrgs.kernels.gpu_spec import device_function
from mrgs.kernels.rasterize.gpu.constants import (
    GRAD_ACROSS,
    GRAD_ACROSS_ACROSS,
    GRAD_ACROSS_DY,
    GRAD_COLOR,
    GRAD_DEPTH,
    GRAD_DY,
    GRAD_DY_DY,
    GRAD_FLOATS,
    GRAD_SCALAR,
)
from mrgs.kernels.rasterize.gpu.projection import (
    clamped_slope,
    covariance,
    cross,
    dot,
    jacobian_row,
    load_intrinsics,
    load_quaternion,
    load_rotation,
    load_three,
    rotation,
    row_times_matrix,
    scaled,
    to_camera,
)


@device_function
def _combination(a, x, b, y):
    """a x + b y of two vectors of three."""
    return a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2]


@device_function
def _screen_gradients(n0, n1, dilation, moments, mask):
    """∂L/∂μ' and the rows of ∂L/∂N from the moments of v = α ∂L/∂α = ∂L/∂(ln G').

    In the record's coordinates, across = dx − shear·dy and dy, Σ' is diagonal, with var(across) and
    yy, so that nothing cancels for thin slanting Gaussians: ln G' = −½ (across² / var(across) +
    dy² / yy), ∂L/∂μ' = Σ v Σ'⁻¹ d and ∂L/∂N = (Σ'⁻¹ (Σ v d dᵀ) Σ'⁻¹) N, the rows of N being
    n_across = n0 − shear·n1 = (n1 × (n0 × n1) + d n0) / yy and n1.
    """
    _, xy, yy, determinant = covariance(n0, n1, dilation)
    shear = xy / yy
    per_across, per_dy = yy / determinant, 1.0 / yy
    grad_across = tl.load(moments + GRAD_ACROSS, mask=mask, other=0.0) * per_across
    grad_dy = tl.load(moments + GRAD_DY, mask=mask, other=0.0) * per_dy
    across_across = (
        tl.load(moments + GRAD_ACROSS_ACROSS, mask=mask, other=0.0) * per_across * per_across
    )
    across_dy = tl.load(moments + GRAD_ACROSS_DY, mask=mask, other=0.0) * per_across * per_dy
    dy_dy = tl.load(moments + GRAD_DY_DY, mask=mask, other=0.0) * per_dy * per_dy
    n_across = _combination(1.0 / yy, cross(n1, cross(n0, n1)), dilation / yy, n0)
    grad_n_across = _combination(across_across, n_across, across_dy, n1)
    grad_n_dy = _combination(across_dy, n_across, dy_dy, n1)
    grad_mean = (grad_across, grad_dy - shear * grad_across)
    return grad_mean, grad_n_across, _combination(1.0, grad_n_dy, -shear, grad_n_across)


@device_function
def _quaternion_gradient(quaternion, length, g0, g1, g2):
    """∂L/∂quaternion from ∂L/∂R (its rows), through the normalisation."""
    w, x, y, z = quaternion
    gw = 2 * (x * (g2[1] - g1[2]) + y * (g0[2] - g2[0]) + z * (g1[0] - g0[1]))
    gx = 2 * (
        y * (g0[1] + g1[0]) + z * (g0[2] + g2[0]) + w * (g2[1] - g1[2]) - 2 * x * (g1[1] + g2[2])
    )
    gy = 2 * (
        x * (g0[1] + g1[0]) + z * (g1[2] + g2[1]) + w * (g0[2] - g2[0]) - 2 * y * (g0[0] + g2[2])
    )
    gz = 2 * (
        x * (g0[2] + g2[0]) + y * (g1[2] + g2[1]) + w * (g1[0] - g0[1]) - 2 * z * (g0[0] + g1[1])
    )
    along = gw * w + gx * x + gy * y + gz * z
    return (
        (gw - along * w) / length,
        (gx - along * x) / length,
        (gy - along * y) / length,
        (gz - along * z) / length,
    )


@device_function
def _axis_gradient(grad_row, viewmat, row: tl.constexpr, focal, across, z, slope, grad_mean):
    """What one image axis adds to ∂L/∂(centre in camera coordinates), along that axis and along
    z."""
    grad_own, grad_forward = (
        dot(grad_row, load_rotation(viewmat, row)),
        dot(grad_row, load_rotation(viewmat, 2)),
    )
    focal_over_z = focal / z
    is_free = slope == across / z  # not clamped
    grad_slope = tl.where(is_free, focal_over_z * grad_forward, 0.0)
    grad_across = focal_over_z * grad_mean - grad_slope / z
    from_slope = grad_slope * (across / z) - focal_over_z * (grad_own - slope * grad_forward)
    return grad_across, (from_slope - focal * (across / z) * grad_mean) / z


@device_function
def _store_three(tensor, i, mask, values):
    tl.store(tensor + 3 * i, values[0], mask=mask)
    tl.store(tensor + 3 * i + 1, values[1], mask=mask)
    tl.store(tensor + 3 * i + 2, values[2], mask=mask)


@device_function
def _store_layer_gradients(
    i, mask, moments, opacities, grad_opacities, grad_features, FIRST: tl.constexpr,
    CHANNELS: tl.constexpr
):  # fmt: skip
    """∂L/∂o = Σ v / o and ∂L/∂features of one layer."""
    grad = tl.load(moments + FIRST, mask=mask, other=0.0)
    opacity = tl.load(opacities + i, mask=mask, other=0.0)
    is_opaque = opacity > 0.0
    tl.store(
        grad_opacities + i,
        tl.where(is_opaque, grad / tl.where(is_opaque, opacity, 1.0), 0.0),
        mask=mask,
    )
    for channel in tl.static_range(CHANNELS):
        value = tl.load(moments + FIRST + 1 + channel, mask=mask, other=0.0)
        tl.store(grad_features + CHANNELS * i + channel, value, mask=mask)


@triton.jit(do_not_specialize=["count", "width", "height"])
def project_backward(
    means, quats, scales, opacities_color, opacities_scalar, viewmat, K, radii, gaussian_grads,
    grad_means, grad_quats, grad_scales, grad_opacities_color, grad_features_color,
    grad_opacities_scalar, grad_features_scalar, grad_means2d_offset, count, width, height,
    dilation,
    HAS_COLOR: tl.constexpr, HAS_SCALAR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Chain the moments of each Gaussian back to its parameters.

    Args:
        means, ..., opacities_scalar, viewmat, K, count, width, height, dilation: as in
            ``projection.project``.
        radii: what that wrote.
        gaussian_grads: moments per Gaussian, [N, 12].
        grad_*: filled, with 0 for the Gaussians that are left out.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    moments = gaussian_grads + i * GRAD_FLOATS
    if HAS_COLOR:
        _store_layer_gradients(
            i,
            inside,
            moments,
            opacities_color,
            grad_opacities_color,
            grad_features_color,
            GRAD_COLOR,
            3,
        )
    if HAS_SCALAR:
        _store_layer_gradients(
            i,
            inside,
            moments,
            opacities_scalar,
            grad_opacities_scalar,
            grad_features_scalar,
            GRAD_SCALAR,
            1,
        )
    drawn = tl.load(radii + i, mask=inside, other=0.0) > 0.0
    x, y, z, _ = to_camera(load_three(means, i, drawn), viewmat)
    fx, fy, cx, cy = load_intrinsics(K)
    u, v = clamped_slope(x / z, fx, cx, width), clamped_slope(y / z, fy, cy, height)
    m0, m1 = jacobian_row(viewmat, 0, fx / z, u), jacobian_row(viewmat, 1, fy / z, v)
    quaternion, length = load_quaternion(quats, i, drawn)
    row0, row1, row2 = rotation(quaternion)
    scale = load_three(scales, i, drawn)
    p0, p1 = row_times_matrix(m0, row0, row1, row2), row_times_matrix(m1, row0, row1, row2)
    n0, n1 = scaled(p0, scale), scaled(p1, scale)
    grad_mean, gn0, gn1 = _screen_gradients(n0, n1, dilation, moments, drawn)
    tl.store(grad_means2d_offset + 2 * i, grad_mean[0], mask=inside)
    tl.store(grad_means2d_offset + 2 * i + 1, grad_mean[1], mask=inside)
    grad_scale = (
        gn0[0] * p0[0] + gn1[0] * p1[0],
        gn0[1] * p0[1] + gn1[1] * p1[1],
        gn0[2] * p0[2] + gn1[2] * p1[2],
    )
    _store_three(grad_scales, i, inside, grad_scale)
    gp0, gp1 = scaled(gn0, scale), scaled(gn1, scale)
    gr0 = _combination(m0[0], gp0, m1[0], gp1)
    gr1 = _combination(m0[1], gp0, m1[1], gp1)
    gr2 = _combination(m0[2], gp0, m1[2], gp1)
    gw, gx, gy, gz = _quaternion_gradient(quaternion, length, gr0, gr1, gr2)
    tl.store(grad_quats + 4 * i, gw, mask=inside)
    tl.store(grad_quats + 4 * i + 1, gx, mask=inside)
    tl.store(grad_quats + 4 * i + 2, gy, mask=inside)
    tl.store(grad_quats + 4 * i + 3, gz, mask=inside)
    gm0 = (dot(gp0, row0), dot(gp0, row1), dot(gp0, row2))
    gm1 = (dot(gp1, row0), dot(gp1, row1), dot(gp1, row2))
    gx, gz0 = _axis_gradient(gm0, viewmat, 0, fx, x, z, u, grad_mean[0])
    gy, gz1 = _axis_gradient(gm1, viewmat, 1, fy, y, z, v, grad_mean[1])
    gz = gz0 + gz1 + tl.load(moments + GRAD_DEPTH, mask=drawn, other=0.0)
    right, down, forward = (
        load_rotation(viewmat, 0),
        load_rotation(viewmat, 1),
        load_rotation(viewmat, 2),
    )
    grad_point = (
        right[0] * gx + down[0] * gy + forward[0] * gz,
        right[1] * gx + down[1] * gy + forward[1] * gz,
        right[2] * gx + down[2] * gy + forward[2] * gz,
    )
    _store_three(grad_means, i, inside, grad_point)
