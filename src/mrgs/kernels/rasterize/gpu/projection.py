"""EWA projection of the Gaussians, one thread per Gaussian, in single precision.

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
def load_three(tensor, i, mask):
    """Row i of a tensor of three columns."""
    return (
        tl.load(tensor + 3 * i, mask=mask, other=0.0),
        tl.load(tensor + 3 * i + 1, mask=mask, other=0.0),
        tl.load(tensor + 3 * i + 2, mask=mask, other=0.0),
    )


@device_function
def load_rotation(viewmat, row: tl.constexpr):
    """A row of the camera's rotation."""
    return (
        tl.load(viewmat + 4 * row),
        tl.load(viewmat + 4 * row + 1),
        tl.load(viewmat + 4 * row + 2),
    )


@device_function
def load_intrinsics(K):
    """fx, fy, cx, cy."""
    return tl.load(K), tl.load(K + 4), tl.load(K + 2), tl.load(K + 5)


@device_function
def dot(a, b):
    """Scalar product of two vectors of three."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device_function
def cross(a, b):
    """Vector product of two vectors of three."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@device_function
def scaled(row, scales):
    """A row vector with its entries multiplied by the scales."""
    return row[0] * scales[0], row[1] * scales[1], row[2] * scales[2]


@device_function
def row_times_matrix(row, row0, row1, row2):
    """A row vector times a 3×3 matrix that is given by its rows."""
    return (
        row[0] * row0[0] + row[1] * row1[0] + row[2] * row2[0],
        row[0] * row0[1] + row[1] * row1[1] + row[2] * row2[1],
        row[0] * row0[2] + row[1] * row1[2] + row[2] * row2[2],
    )


@device_function
def load_quaternion(quats, i, mask):
    """Quaternion i, normalised, and its length; the identity where masked."""
    w, x = (
        tl.load(quats + 4 * i, mask=mask, other=1.0),
        tl.load(quats + 4 * i + 1, mask=mask, other=0.0),
    )
    y, z = (
        tl.load(quats + 4 * i + 2, mask=mask, other=0.0),
        tl.load(quats + 4 * i + 3, mask=mask, other=0.0),
    )
    length = tl.sqrt(w * w + x * x + y * y + z * z)
    return (w / length, x / length, y / length, z / length), length


@device_function
def rotation(quaternion):
    """The rows of the rotation matrix of a normalised quaternion."""
    w, x, y, z = quaternion
    row0 = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y))
    row1 = (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x))
    row2 = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    return row0, row1, row2


@device_function
def to_camera(point, viewmat):
    """Centres in camera coordinates, and whether they lie before the camera; where not, z is 1."""
    x = dot(load_rotation(viewmat, 0), point) + tl.load(viewmat + 3)
    y = dot(load_rotation(viewmat, 1), point) + tl.load(viewmat + 7)
    z = dot(load_rotation(viewmat, 2), point) + tl.load(viewmat + 11)
    in_front = z >= NEAR_PLANE
    return x, y, tl.where(in_front, z, 1.0), in_front


@device_function
def clamped_slope(slope, focal, centre, size):
    """x/z (or y/z), clamped to the widened image: outside it the linearisation J would explode."""
    margin = size / focal * (0.5 * MARGIN)
    return tl.minimum(tl.maximum(slope, -centre / focal - margin), (size - centre) / focal + margin)


@device_function
def jacobian_row(viewmat, row: tl.constexpr, focal_over_z, slope):
    """Row 0 or 1 of M = J R_w."""
    own, forward = load_rotation(viewmat, row), load_rotation(viewmat, 2)
    return (
        focal_over_z * (own[0] - slope * forward[0]),
        focal_over_z * (own[1] - slope * forward[1]),
        focal_over_z * (own[2] - slope * forward[2]),
    )


@device_function
def covariance(n0, n1, dilation):
    """Entries xx, xy, yy of Σ', then det Σ'."""
    xx, yy = dot(n0, n0), dot(n1, n1)
    area = cross(n0, n1)
    determinant = dot(area, area) + (xx + yy) * dilation + dilation * dilation
    return xx + dilation, dot(n0, n1), yy + dilation, determinant


@device_function
def _store_layers(
    record, i, mask, opacities_color, features_color, opacities_scalar, features_scalar,
    HAS_COLOR: tl.constexpr, HAS_SCALAR: tl.constexpr,
):  # fmt: skip
    """The layers' parts of the records."""
    if HAS_COLOR:
        red, green, blue = load_three(features_color, i, mask)
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
    x, y, z, visible = to_camera(load_three(means, i, inside), viewmat)
    fx, fy, cx, cy = load_intrinsics(K)
    m0 = jacobian_row(viewmat, 0, fx / z, clamped_slope(x / z, fx, cx, width))
    m1 = jacobian_row(viewmat, 1, fy / z, clamped_slope(y / z, fy, cy, height))
    quaternion, _ = load_quaternion(quats, i, inside)
    row0, row1, row2 = rotation(quaternion)
    scale = load_three(scales, i, inside)
    n0 = scaled(row_times_matrix(m0, row0, row1, row2), scale)
    n1 = scaled(row_times_matrix(m1, row0, row1, row2), scale)
    along_axis = scaled(row_times_matrix(load_rotation(viewmat, 2), row0, row1, row2), scale)
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
