"""EWA projection of the Gaussians and its backward, one thread per Gaussian, in single precision.

With J the Jacobian of the perspective projection, R_w the camera's rotation, R and S the Gaussian's
rotation and scales: Σ' = N Nᵀ + d I for the 2×3 matrix N = (J R_w) R S, so that no 3×3 covariance
is ever formed. With n_0 and n_1 the rows of N, det(N Nᵀ) = |n_0 × n_1|² and det Σ' = |n_0 × n_1|² +
d (|n_0|² + |n_1|²) + d²: sums of what is never negative, so that nothing cancels even for Gaussians
that are thin and long.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mrgs.kernels.gpu_spec import device_function
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
def _load_rotation(viewmat, row: tl.constexpr):
    """A row of the camera's rotation."""
    return (
        tl.load(viewmat + 4 * row),
        tl.load(viewmat + 4 * row + 1),
        tl.load(viewmat + 4 * row + 2),
    )


@device_function
def _load_intrinsics(K):
    """fx, fy, cx, cy."""
    return tl.load(K), tl.load(K + 4), tl.load(K + 2), tl.load(K + 5)


@device_function
def _dot(a, b):
    """Scalar product of two vectors of three."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device_function
def _cross(a, b):
    """Vector product of two vectors of three."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@device_function
def _scaled(row, scales):
    """A row vector with its entries multiplied by the scales."""
    return row[0] * scales[0], row[1] * scales[1], row[2] * scales[2]


@device_function
def _row_times_matrix(row, row0, row1, row2):
    """A row vector times a 3×3 matrix that is given by its rows."""
    return (
        row[0] * row0[0] + row[1] * row1[0] + row[2] * row2[0],
        row[0] * row0[1] + row[1] * row1[1] + row[2] * row2[1],
        row[0] * row0[2] + row[1] * row1[2] + row[2] * row2[2],
    )


@device_function
def _load_quaternion(quats, i, mask):
    """Quaternion i, normalised, and its length; the identity where masked."""
    w = tl.load(quats + 4 * i, mask=mask, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=mask, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=mask, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=mask, other=0.0)
    length = tl.sqrt(w * w + x * x + y * y + z * z)
    return (w / length, x / length, y / length, z / length), length


@device_function
def _rotation(quaternion):
    """The rows of the rotation matrix of a normalised quaternion."""
    w, x, y, z = quaternion
    row0 = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y))
    row1 = (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x))
    row2 = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    return row0, row1, row2


@device_function
def _to_camera(point, viewmat):
    """Centres in camera coordinates, and whether they lie before the camera; where not, z is 1."""
    x = _dot(_load_rotation(viewmat, 0), point) + tl.load(viewmat + 3)
    y = _dot(_load_rotation(viewmat, 1), point) + tl.load(viewmat + 7)
    z = _dot(_load_rotation(viewmat, 2), point) + tl.load(viewmat + 11)
    in_front = z >= NEAR_PLANE
    return x, y, tl.where(in_front, z, 1.0), in_front


@device_function
def _clamped_slope(slope, focal, centre, size):
    """x/z (or y/z), clamped to the widened image: outside it the linearisation J would explode."""
    margin = size / focal * (0.5 * MARGIN)
    return tl.minimum(tl.maximum(slope, -centre / focal - margin), (size - centre) / focal + margin)


@device_function
def _jacobian_row(viewmat, row: tl.constexpr, focal_over_z, slope):
    """Row 0 or 1 of M = J R_w."""
    own, forward = _load_rotation(viewmat, row), _load_rotation(viewmat, 2)
    return (
        focal_over_z * (own[0] - slope * forward[0]),
        focal_over_z * (own[1] - slope * forward[1]),
        focal_over_z * (own[2] - slope * forward[2]),
    )


@device_function
def _covariance(n0, n1, dilation):
    """Entries xx, xy, yy of Σ', then det Σ'."""
    xx, yy = _dot(n0, n0), _dot(n1, n1)
    area = _cross(n0, n1)
    determinant = _dot(area, area) + (xx + yy) * dilation + dilation * dilation
    return xx + dilation, _dot(n0, n1), yy + dilation, determinant


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
    splats, radii, depths, pair_counts, count, width, height, dilation,
    HAS_COLOR: tl.constexpr, HAS_SCALAR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill the records [N, 16], radii [N], depths [N] (infinite if left out) and the numbers of
    tiles reached [N].

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
    m0 = _jacobian_row(viewmat, 0, fx / z, _clamped_slope(x / z, fx, cx, width))
    m1 = _jacobian_row(viewmat, 1, fy / z, _clamped_slope(y / z, fy, cy, height))
    quaternion, _ = _load_quaternion(quats, i, inside)
    row0, row1, row2 = _rotation(quaternion)
    scale = _load_three(scales, i, inside)
    n0 = _scaled(_row_times_matrix(m0, row0, row1, row2), scale)
    n1 = _scaled(_row_times_matrix(m1, row0, row1, row2), scale)
    along_axis = _scaled(_row_times_matrix(_load_rotation(viewmat, 2), row0, row1, row2), scale)
    xx, xy, yy, determinant = _covariance(n0, n1, dilation)
    visible &= inside & (opacity >= ALPHA_MIN) & (_dot(along_axis, along_axis) <= z * z)
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
    tl.store(depths + i, tl.where(visible, z, float("inf")), mask=inside)
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
    _, xy, yy, determinant = _covariance(n0, n1, dilation)
    shear = xy / yy
    per_across, per_dy = yy / determinant, 1.0 / yy
    grad_across = tl.load(moments + GRAD_ACROSS, mask=mask, other=0.0) * per_across
    grad_dy = tl.load(moments + GRAD_DY, mask=mask, other=0.0) * per_dy
    across_across = (
        tl.load(moments + GRAD_ACROSS_ACROSS, mask=mask, other=0.0) * per_across * per_across
    )
    across_dy = tl.load(moments + GRAD_ACROSS_DY, mask=mask, other=0.0) * per_across * per_dy
    dy_dy = tl.load(moments + GRAD_DY_DY, mask=mask, other=0.0) * per_dy * per_dy
    n_across = _combination(1.0 / yy, _cross(n1, _cross(n0, n1)), dilation / yy, n0)
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
    grad_own = _dot(grad_row, _load_rotation(viewmat, row))
    grad_forward = _dot(grad_row, _load_rotation(viewmat, 2))
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
    """Chain the moments of each Gaussian back to its parameters.

    Args:
        means, ..., opacities_scalar, viewmat, K, count, width, height, dilation: as in ``project``.
        radii: what that wrote.
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
    m0, m1 = _jacobian_row(viewmat, 0, fx / z, u), _jacobian_row(viewmat, 1, fy / z, v)
    quaternion, length = _load_quaternion(quats, i, drawn)
    row0, row1, row2 = _rotation(quaternion)
    scale = _load_three(scales, i, drawn)
    p0, p1 = _row_times_matrix(m0, row0, row1, row2), _row_times_matrix(m1, row0, row1, row2)
    n0, n1 = _scaled(p0, scale), _scaled(p1, scale)
    grad_mean, gn0, gn1 = _screen_gradients(n0, n1, dilation, moments, drawn)
    tl.store(grad_means2d_offset + 2 * i, grad_mean[0], mask=inside)
    tl.store(grad_means2d_offset + 2 * i + 1, grad_mean[1], mask=inside)
    grad_scale = (
        gn0[0] * p0[0] + gn1[0] * p1[0],
        gn0[1] * p0[1] + gn1[1] * p1[1],
        gn0[2] * p0[2] + gn1[2] * p1[2],
    )
    store_three(grad_scales, i, inside, grad_scale)
    gp0, gp1 = _scaled(gn0, scale), _scaled(gn1, scale)
    gr0 = _combination(m0[0], gp0, m1[0], gp1)
    gr1 = _combination(m0[1], gp0, m1[1], gp1)
    gr2 = _combination(m0[2], gp0, m1[2], gp1)
    gw, gx, gy, gz = _quaternion_gradient(quaternion, length, gr0, gr1, gr2)
    tl.store(grad_quats + 4 * i, gw, mask=inside)
    tl.store(grad_quats + 4 * i + 1, gx, mask=inside)
    tl.store(grad_quats + 4 * i + 2, gy, mask=inside)
    tl.store(grad_quats + 4 * i + 3, gz, mask=inside)
    gm0 = (_dot(gp0, row0), _dot(gp0, row1), _dot(gp0, row2))
    gm1 = (_dot(gp1, row0), _dot(gp1, row1), _dot(gp1, row2))
    gx, gz0 = _axis_gradient(gm0, viewmat, 0, fx, x, z, u, grad_mean[0])
    gy, gz1 = _axis_gradient(gm1, viewmat, 1, fy, y, z, v, grad_mean[1])
    gz = gz0 + gz1 + tl.load(moments + GRAD_DEPTH, mask=drawn, other=0.0)
    right, down = _load_rotation(viewmat, 0), _load_rotation(viewmat, 1)
    forward = _load_rotation(viewmat, 2)
    grad_point = (
        right[0] * gx + down[0] * gy + forward[0] * gz,
        right[1] * gx + down[1] * gy + forward[1] * gz,
        right[2] * gx + down[2] * gy + forward[2] * gz,
    )
    store_three(grad_means, i, inside, grad_point)
