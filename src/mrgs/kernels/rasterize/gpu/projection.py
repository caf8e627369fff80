"""EWA projection of the Gaussians and its backward (``ewa``), a thread each, in float32."""

from __future__ import annotations

import triton
import triton.language as tl

from mrgs.kernels.gpu_spec import device_function
from mrgs.kernels.rasterize import ewa
from mrgs.kernels.rasterize.gpu.constants import (
    ACROSS,
    ALONG,
    ALPHA_MIN,
    COLOR,
    DEPTH,
    EXPONENT,
    EXTENT_Y,
    GRAD_ACROSS,
    GRAD_ACROSS_ACROSS,
    GRAD_ACROSS_DY,
    GRAD_COLOR,
    GRAD_DEPTH,
    GRAD_DY,
    GRAD_DY_DY,
    GRAD_FLOATS,
    GRAD_SCALAR,
    HALF_WIDTH,
    LARGEST_PX,
    MARGIN,
    MEAN_X,
    MEAN_Y,
    NEAR_PLANE,
    SCALAR,
    SHEAR,
    SPLAT_FLOATS,
)
from mrgs.kernels.rasterize.gpu.tiles import count_pairs

(
    dot, scaled, row_times_matrix, rotation_of, jacobian_row, covariance, screen_gradients,
    rotation_gradient, quaternion_gradient,
) = ewa.functions(device_function)  # fmt: skip


@device_function
def _load_three(tensor, i, mask):
    """Row i of a tensor of three columns."""
    return (
        tl.load(tensor + 3 * i, mask=mask, other=0.0),
        tl.load(tensor + 3 * i + 1, mask=mask, other=0.0),
        tl.load(tensor + 3 * i + 2, mask=mask, other=0.0),
    )


@device_function
def store_three(tensor, i, mask, values):
    """Into row i of a tensor of three columns."""
    tl.store(tensor + 3 * i, values[0], mask=mask)
    tl.store(tensor + 3 * i + 1, values[1], mask=mask)
    tl.store(tensor + 3 * i + 2, values[2], mask=mask)


@device_function
def _load_axes(viewmat):
    """The rows of the camera's rotation: right, down and forward."""
    right = (tl.load(viewmat), tl.load(viewmat + 1), tl.load(viewmat + 2))
    down = (tl.load(viewmat + 4), tl.load(viewmat + 5), tl.load(viewmat + 6))
    return right, down, (tl.load(viewmat + 8), tl.load(viewmat + 9), tl.load(viewmat + 10))


@device_function
def _load_intrinsics(K):
    """fx, fy, cx, cy."""
    return tl.load(K), tl.load(K + 4), tl.load(K + 2), tl.load(K + 5)


@device_function
def _load_quaternion(quats, i, mask):
    """Quaternion i, normalised, and one over the length that it had; the identity where masked."""
    w = tl.load(quats + 4 * i, mask=mask, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=mask, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=mask, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=mask, other=0.0)
    length = tl.sqrt(w * w + x * x + y * y + z * z)
    return (w / length, x / length, y / length, z / length), 1.0 / length


@device_function
def _to_camera(point, viewmat):
    """Centres in camera coordinates, and whether they lie before the camera; where not, z is 1."""
    right, down, forward = _load_axes(viewmat)
    x = dot(right, point) + tl.load(viewmat + 3)
    y = dot(down, point) + tl.load(viewmat + 7)
    z = dot(forward, point) + tl.load(viewmat + 11)
    in_front = z >= NEAR_PLANE
    return x, y, tl.where(in_front, z, 1.0), in_front


@device_function
def _clamped_slope(slope, focal, centre, size):
    """x/z (or y/z), clamped to the widened image: outside it the linearisation J would explode."""
    margin = size / focal * (0.5 * MARGIN)
    return tl.minimum(tl.maximum(slope, -centre / focal - margin), (size - centre) / focal + margin)


@device_function
def _store_layers(
    record, i, mask, opacities_color, features_color, opacities_scalar, features_scalar,
    HAS_COLOR: tl.constexpr, HAS_SCALAR: tl.constexpr,
):  # fmt: skip
    """The layers' parts of the records."""
    if HAS_COLOR:
        red, green, blue = _load_three(features_color, i, mask)
        tl.store(record + COLOR, tl.load(opacities_color + i, mask=mask, other=0.0), mask=mask)
        tl.store(record + COLOR + 1, red, mask=mask)
        tl.store(record + COLOR + 2, green, mask=mask)
        tl.store(record + COLOR + 3, blue, mask=mask)
    if HAS_SCALAR:
        tl.store(record + SCALAR, tl.load(opacities_scalar + i, mask=mask, other=0.0), mask=mask)
        tl.store(record + SCALAR + 1, tl.load(features_scalar + i, mask=mask, other=0.0), mask=mask)


@triton.jit(do_not_specialize=["count", "width", "height"])
def project(
    means, quats, scales, opacities_color, features_color, opacities_scalar, features_scalar,
    means2d_offset, viewmat, K,
    splats, radii, distances, pair_counts, count, width, height, dilation,
    HAS_COLOR: tl.constexpr, HAS_SCALAR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill the records [N, 16], radii [N], distances from the camera's centre [N] (infinite if
    left out) and the numbers of tiles reached [N].

    Args:
        means, quats, scales: [N, 3], [N, 4], [N, 3].
        opacities_color, features_color: [N] and [N, 3], not read without HAS_COLOR.
        opacities_scalar, features_scalar: [N] and [N, 1], not read without HAS_SCALAR.
        means2d_offset: pixels, [N, 2].
        viewmat, K: [4, 4] and [3, 3].
        count, width, height: N and the size of the image.
        dilation: d, px².
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    opacity = tl.zeros([BLOCK], tl.float32)
    if HAS_COLOR:
        opacity = tl.maximum(opacity, tl.load(opacities_color + i, mask=inside, other=0.0))
    if HAS_SCALAR:
        opacity = tl.maximum(opacity, tl.load(opacities_scalar + i, mask=inside, other=0.0))
    x, y, z, visible = _to_camera(_load_three(means, i, inside), viewmat)
    fx, fy, cx, cy = _load_intrinsics(K)
    right, down, forward = _load_axes(viewmat)
    m0 = jacobian_row(fx / z, _clamped_slope(x / z, fx, cx, width), right, forward)
    m1 = jacobian_row(fy / z, _clamped_slope(y / z, fy, cy, height), down, forward)
    quaternion, _ = _load_quaternion(quats, i, inside)
    rotation, scale = rotation_of(quaternion), _load_three(scales, i, inside)
    n0 = scaled(row_times_matrix(m0, rotation), scale)
    n1 = scaled(row_times_matrix(m1, rotation), scale)
    along_axis = scaled(row_times_matrix(forward, rotation), scale)
    xx, xy, yy, determinant = covariance(n0, n1, dilation)
    visible &= inside & (opacity >= ALPHA_MIN) & (dot(along_axis, along_axis) <= z * z)
    # dᵀ Σ'⁻¹ d where α = 1/255; not quite 0, so that the ellipse keeps its shape.
    reach = tl.maximum(2.0 * tl.log(tl.maximum(opacity, ALPHA_MIN) / ALPHA_MIN), 1e-12)
    mean_x = fx * x / z + cx + tl.load(means2d_offset + 2 * i, mask=inside, other=0.0)
    mean_y = fy * y / z + cy + tl.load(means2d_offset + 2 * i + 1, mask=inside, other=0.0)
    extent_x, extent_y = tl.sqrt(reach * xx), tl.sqrt(reach * yy)
    visible &= (determinant > 0.0) & (
        tl.abs(mean_x) + tl.abs(mean_y) + extent_x + extent_y < LARGEST_PX
    )
    visible &= (mean_x + extent_x >= 0.0) & (mean_x - extent_x <= width)
    visible &= (mean_y + extent_y >= 0.0) & (mean_y - extent_y <= height)
    half_difference = 0.5 * (xx - yy)
    largest_variance = 0.5 * (xx + yy) + tl.sqrt(half_difference * half_difference + xy * xy)
    shear, half_width = xy / yy, tl.sqrt(reach * (determinant / yy))
    pairs = count_pairs(visible, mean_x, mean_y, shear, extent_y, half_width, width, height)
    tl.store(
        radii + i,
        tl.where(visible, tl.maximum(tl.sqrt(reach * largest_variance), 1e-6), 0.0),
        mask=inside,
    )
    distance = tl.sqrt(x * x + y * y + z * z)
    tl.store(distances + i, tl.where(visible, distance, float("inf")), mask=inside)
    tl.store(pair_counts + i, pairs, mask=inside)
    record = splats + i * SPLAT_FLOATS
    tl.store(record + MEAN_X, mean_x, mask=visible)
    tl.store(record + MEAN_Y, mean_y, mask=visible)
    tl.store(record + ACROSS, yy / determinant * EXPONENT, mask=visible)
    tl.store(record + SHEAR, shear, mask=visible)
    tl.store(record + ALONG, 1.0 / yy * EXPONENT, mask=visible)
    tl.store(record + EXTENT_Y, extent_y, mask=visible)
    tl.store(record + HALF_WIDTH, half_width, mask=visible)
    tl.store(record + DEPTH, z, mask=visible)
    _store_layers(
        record, i, visible, opacities_color, features_color, opacities_scalar, features_scalar,
        HAS_COLOR, HAS_SCALAR,
    )  # fmt: skip


@device_function
def _load_moments(moments, mask):
    """The five moments that ``ewa.screen_gradients`` takes."""
    return (
        tl.load(moments + GRAD_ACROSS, mask=mask, other=0.0),
        tl.load(moments + GRAD_DY, mask=mask, other=0.0),
        tl.load(moments + GRAD_ACROSS_ACROSS, mask=mask, other=0.0),
        tl.load(moments + GRAD_ACROSS_DY, mask=mask, other=0.0),
        tl.load(moments + GRAD_DY_DY, mask=mask, other=0.0),
    )


@device_function
def _axis_gradient(grad_row, own, forward, focal, across, z, slope, grad_mean):
    """What one image axis adds to ∂L/∂(centre in camera axes), along that axis and along z."""
    grad_own, grad_forward = dot(grad_row, own), dot(grad_row, forward)
    focal_over_z = focal / z
    is_free = slope == across / z  # not clamped
    grad_slope = tl.where(is_free, focal_over_z * grad_forward, 0.0)
    grad_across = focal_over_z * grad_mean - grad_slope / z
    from_slope = grad_slope * (across / z) - focal_over_z * (grad_own - slope * grad_forward)
    return grad_across, (from_slope - focal * (across / z) * grad_mean) / z


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
    """Chain the moments of each Gaussian back to its parameters; for the arguments not named here
    see ``project``.

    Args:
        radii: as ``project`` wrote them.
        gaussian_grads: moments per Gaussian, [N, 12].
        grad_*: filled, with 0 for the Gaussians that are left out.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    moments = gaussian_grads + i * GRAD_FLOATS
    if HAS_COLOR:
        _store_layer_gradients(
            i, inside, moments, opacities_color, grad_opacities_color, grad_features_color,
            GRAD_COLOR, 3,
        )  # fmt: skip
    if HAS_SCALAR:
        _store_layer_gradients(
            i, inside, moments, opacities_scalar, grad_opacities_scalar, grad_features_scalar,
            GRAD_SCALAR, 1,
        )  # fmt: skip
    drawn = tl.load(radii + i, mask=inside, other=0.0) > 0.0
    x, y, z, _ = _to_camera(_load_three(means, i, drawn), viewmat)
    fx, fy, cx, cy = _load_intrinsics(K)
    u, v = _clamped_slope(x / z, fx, cx, width), _clamped_slope(y / z, fy, cy, height)
    right, down, forward = _load_axes(viewmat)
    m0, m1 = jacobian_row(fx / z, u, right, forward), jacobian_row(fy / z, v, down, forward)
    quaternion, inverse_length = _load_quaternion(quats, i, drawn)
    rotation, scale = rotation_of(quaternion), _load_three(scales, i, drawn)
    p0, p1 = row_times_matrix(m0, rotation), row_times_matrix(m1, rotation)
    n0, n1 = scaled(p0, scale), scaled(p1, scale)
    grad_mean, gn0, gn1 = screen_gradients(n0, n1, dilation, _load_moments(moments, drawn))
    tl.store(grad_means2d_offset + 2 * i, grad_mean[0], mask=inside)
    tl.store(grad_means2d_offset + 2 * i + 1, grad_mean[1], mask=inside)
    grad_scale = (
        gn0[0] * p0[0] + gn1[0] * p1[0],
        gn0[1] * p0[1] + gn1[1] * p1[1],
        gn0[2] * p0[2] + gn1[2] * p1[2],
    )
    store_three(grad_scales, i, inside, grad_scale)
    gp0, gp1 = scaled(gn0, scale), scaled(gn1, scale)
    grad_rotation = rotation_gradient(m0, m1, gp0, gp1)
    gw, gx, gy, gz = quaternion_gradient(quaternion, inverse_length, grad_rotation)
    tl.store(grad_quats + 4 * i, gw, mask=inside)
    tl.store(grad_quats + 4 * i + 1, gx, mask=inside)
    tl.store(grad_quats + 4 * i + 2, gy, mask=inside)
    tl.store(grad_quats + 4 * i + 3, gz, mask=inside)
    gm0 = (dot(gp0, rotation[0]), dot(gp0, rotation[1]), dot(gp0, rotation[2]))
    gm1 = (dot(gp1, rotation[0]), dot(gp1, rotation[1]), dot(gp1, rotation[2]))
    gx, gz0 = _axis_gradient(gm0, right, forward, fx, x, z, u, grad_mean[0])
    gy, gz1 = _axis_gradient(gm1, down, forward, fy, y, z, v, grad_mean[1])
    gz = gz0 + gz1 + tl.load(moments + GRAD_DEPTH, mask=drawn, other=0.0)
    grad_point = row_times_matrix((gx, gy, gz), (right, down, forward))
    store_three(grad_means, i, inside, grad_point)
