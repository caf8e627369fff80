"""EWA projection of the Gaussians and its backward (``ewa``), one per turn, in double precision."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from mrgs.kernels.jit import address, strict_inner_function, strict_parallel_kernel
from mrgs.kernels.rasterize import ewa
from mrgs.kernels.simd import prefetch
from mrgs.rasterizer import contract, splat

NEAR_PLANE = contract.NEAR_PLANE
ALPHA_MIN = contract.ALPHA_MIN
MARGIN = contract.FRUSTUM_MARGIN
LOG2_E = 1.0 / math.log(2.0)
_BLOCK = 256
"""Gaussians that one thread takes at a time in the backward pass."""

_PAIRS_AHEAD = 16
"""Pairs whose moments are asked for before they are read: they are scattered over the memory."""

LARGEST_PX = 1e9
"""Gaussians that reach farther are left out, with those whose place or size is not a number."""


class GaussianArrays(NamedTuple):
    """Arrays of N Gaussians, or their gradients.

    Attributes:
        means, quats, scales: [N, 3], [N, 4], [N, 3].
        opacities: o_c and o_t, [N, 2].
        features: red, green, blue, temperature, [N, 4].
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    features: np.ndarray


(
    dot, scaled, row_times_matrix, rotation_of, jacobian_row, covariance, screen_gradients,
    rotation_gradient, quaternion_gradient,
) = ewa.functions(strict_inner_function)  # fmt: skip


@strict_inner_function()
def _row(matrix, i):
    """The first three entries of a row of a matrix."""
    return matrix[i, 0], matrix[i, 1], matrix[i, 2]


@strict_inner_function()
def _unit_quaternion(quats, i):
    """The normalised quaternion i, and one over the length that it had."""
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    inverse_length = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    unit = (w * inverse_length, x * inverse_length, y * inverse_length, z * inverse_length)
    return unit, inverse_length


@strict_inner_function()
def _to_camera(means, viewmat, i):
    """Centre i in camera coordinates."""
    x, y, z = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
    return (
        viewmat[0, 0] * x + viewmat[0, 1] * y + viewmat[0, 2] * z + viewmat[0, 3],
        viewmat[1, 0] * x + viewmat[1, 1] * y + viewmat[1, 2] * z + viewmat[1, 3],
        viewmat[2, 0] * x + viewmat[2, 1] * y + viewmat[2, 2] * z + viewmat[2, 3],
    )


@strict_inner_function()
def _slope_limits(focal, centre, size):
    """Limits of x/z (or y/z) in J: outside the widened image the linearisation would explode."""
    margin = MARGIN * 0.5 * size / focal
    return -centre / focal - margin, (size - centre) / focal + margin


@strict_inner_function()
def _clamped(slope, limits):
    return min(max(slope, limits[0]), limits[1])


@strict_inner_function()
def _jacobian_times_rotation(inverse_z, u, v, viewmat, fx, fy):
    """The 2×3 matrix M = J R_w, with the clamped slopes u, v in J."""
    forward = _row(viewmat, 2)
    return (
        jacobian_row(fx * inverse_z, u, _row(viewmat, 0), forward),
        jacobian_row(fy * inverse_z, v, _row(viewmat, 1), forward),
    )


@strict_inner_function()
def _axes_in_image(point, rotation, scales, i, viewmat, fx, fy, limits_u, limits_v):
    """The rows of N = (J R_w) R S: the scaled axes of Gaussian i in pixels."""
    inverse_z = 1.0 / point[2]
    u = _clamped(point[0] * inverse_z, limits_u)
    v = _clamped(point[1] * inverse_z, limits_v)
    m0, m1 = _jacobian_times_rotation(inverse_z, u, v, viewmat, fx, fy)
    scale = _row(scales, i)
    return (
        scaled(row_times_matrix(m0, rotation), scale),
        scaled(row_times_matrix(m1, rotation), scale),
    )


@strict_inner_function()
def _axes_along_view(rotation, scales, i, viewmat):
    """r R S, with r the last row of R_w: the depths of the scaled axes of Gaussian i."""
    return scaled(row_times_matrix(_row(viewmat, 2), rotation), _row(scales, i))


@strict_parallel_kernel()
def project(gaussians, projection, means2d_offset, splats, radii):
    """Fill ``splats`` [N, 16] and ``radii`` [N] of ``GaussianArrays``; radius 0 marks one that is
    left out. The projection has matrices in float64, the offset [N, 2] is in pixels."""
    means, quats, scales, opacities, features = gaussians
    viewmat, K, width, height, dilation = projection
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    limits_u, limits_v = _slope_limits(fx, cx, width), _slope_limits(fy, cy, height)
    for i in prange(means.shape[0]):
        radii[i] = 0.0
        opacity = max(opacities[i, 0], opacities[i, 1])
        point = _to_camera(means, viewmat, i)
        if point[2] < NEAR_PLANE or opacity < ALPHA_MIN:
            continue
        rotation = rotation_of(_unit_quaternion(quats, i)[0])
        along_axis = _axes_along_view(rotation, scales, i, viewmat)
        if dot(along_axis, along_axis) > point[2] * point[2]:
            continue
        n0, n1 = _axes_in_image(point, rotation, scales, i, viewmat, fx, fy, limits_u, limits_v)
        xx, xy, yy, determinant = covariance(n0, n1, dilation)
        mean_x = fx * point[0] / point[2] + cx + means2d_offset[i, 0]
        mean_y = fy * point[1] / point[2] + cy + means2d_offset[i, 1]
        reach = 2.0 * math.log(opacity / ALPHA_MIN)  # dᵀ Σ'⁻¹ d where α = 1/255
        extent_x, extent_y = math.sqrt(reach * xx), math.sqrt(reach * yy)
        outside_x = mean_x + extent_x < 0.0 or mean_x - extent_x > width
        outside_y = mean_y + extent_y < 0.0 or mean_y - extent_y > height
        is_usable = (
            determinant > 0.0 and abs(mean_x) + abs(mean_y) + extent_x + extent_y < LARGEST_PX
        )
        if not is_usable or outside_x or outside_y:
            continue
        largest_variance = 0.5 * (xx + yy) + math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        radii[i] = max(math.sqrt(reach * largest_variance), 1e-6)
        splats[i, splat.MEAN_X] = mean_x
        splats[i, splat.MEAN_Y] = mean_y
        splats[i, splat.ACROSS] = -0.5 * LOG2_E * yy / determinant
        splats[i, splat.SHEAR] = xy / yy
        splats[i, splat.ALONG] = -0.5 * LOG2_E / yy
        splats[i, splat.THRESHOLD] = -0.5 * LOG2_E * reach
        splats[i, splat.DEPTH] = point[2]
        splats[i, splat.DISTANCE] = math.sqrt(dot(point, point))
        splats[i, splat.COLOR] = opacities[i, 0]
        for channel in range(3):
            splats[i, splat.COLOR + 1 + channel] = features[i, channel]
        splats[i, splat.SCALAR] = opacities[i, 1]
        splats[i, splat.SCALAR + 1] = features[i, 3]
        splats[i, splat.EXTENT_Y] = extent_y
        splats[i, splat.HALF_WIDTH] = math.sqrt(reach * determinant / yy)


@strict_parallel_kernel()
def depth_slopes(gaussians, projection):
    """Fill the first two columns of the features with ∂z/∂x' / z, the depth's change from pixel to
    pixel (``reference.depth_slopes``); 0 before the near plane. Arguments as for ``project``."""
    means, quats, scales, _, slopes = gaussians
    viewmat, K, width, height, dilation = projection
    fx, fy = K[0, 0], K[1, 1]
    limits_u, limits_v = _slope_limits(fx, K[0, 2], width), _slope_limits(fy, K[1, 2], height)
    for i in prange(means.shape[0]):
        slopes[i, 0], slopes[i, 1] = 0.0, 0.0
        point = _to_camera(means, viewmat, i)
        if point[2] < NEAR_PLANE:
            continue
        rotation = rotation_of(_unit_quaternion(quats, i)[0])
        n0, n1 = _axes_in_image(point, rotation, scales, i, viewmat, fx, fy, limits_u, limits_v)
        xx, xy, yy, determinant = covariance(n0, n1, dilation)
        along_view = _axes_along_view(rotation, scales, i, viewmat)
        xz, yz = dot(n0, along_view), dot(n1, along_view)
        scale = 1.0 / (determinant * point[2])
        slopes[i, 0], slopes[i, 1] = (yy * xz - xy * yz) * scale, (xx * yz - xy * xz) * scale


@strict_inner_function()
def _camera_point_gradient(
    point, inverse_z, u, v, viewmat, fx, fy, grad_m0, grad_m1, grad_mean, grad_depth
):
    """∂L/∂(centre in camera coordinates) from those of M = J R_w, of μ' and of the depth."""
    slope_u, slope_v = point[0] * inverse_z, point[1] * inverse_z
    view0, view1, view2 = _row(viewmat, 0), _row(viewmat, 1), _row(viewmat, 2)
    grad_j00, grad_j02 = dot(grad_m0, view0), dot(grad_m0, view2)
    grad_j11, grad_j12 = dot(grad_m1, view1), dot(grad_m1, view2)
    per_x, per_y = fx * inverse_z, fy * inverse_z
    gx, gy = per_x * grad_mean[0], per_y * grad_mean[1]
    gz = grad_depth - slope_u * gx - slope_v * gy
    gz -= inverse_z * (per_x * (grad_j00 - u * grad_j02) + per_y * (grad_j11 - v * grad_j12))
    if u == slope_u:
        by_slope = per_x * inverse_z * grad_j02
        gx -= by_slope
        gz += slope_u * by_slope
    if v == slope_v:
        by_slope = per_y * inverse_z * grad_j12
        gy -= by_slope
        gz += slope_v * by_slope
    return gx, gy, gz


@strict_inner_function()
def _geometry_gradient(
    i, g, means, quats, scales, viewmat, fx, fy, limits_u, limits_v, dilation,
    grad_means, grad_quats, grad_scales, grad_means2d,
):  # fmt: skip
    """Chain the moments ``g`` of a splat back to centre, rotation and scales of Gaussian i."""
    point = _to_camera(means, viewmat, i)
    inverse_z = 1.0 / point[2]
    u, v = _clamped(point[0] * inverse_z, limits_u), _clamped(point[1] * inverse_z, limits_v)
    m0, m1 = _jacobian_times_rotation(inverse_z, u, v, viewmat, fx, fy)
    unit, inverse_length = _unit_quaternion(quats, i)
    rotation, scale = rotation_of(unit), _row(scales, i)
    p0, p1 = row_times_matrix(m0, rotation), row_times_matrix(m1, rotation)
    n0, n1 = scaled(p0, scale), scaled(p1, scale)
    grad_mean, gn0, gn1 = screen_gradients(n0, n1, dilation, g)
    grad_means2d[i, 0], grad_means2d[i, 1] = grad_mean
    for k in range(3):
        grad_scales[i, k] = gn0[k] * p0[k] + gn1[k] * p1[k]
    gp0, gp1 = scaled(gn0, scale), scaled(gn1, scale)
    grad_rotation = rotation_gradient(m0, m1, gp0, gp1)
    gw, gx, gy, gz = quaternion_gradient(unit, inverse_length, grad_rotation)
    grad_quats[i, 0], grad_quats[i, 1], grad_quats[i, 2], grad_quats[i, 3] = gw, gx, gy, gz
    grad_m0 = (dot(gp0, rotation[0]), dot(gp0, rotation[1]), dot(gp0, rotation[2]))
    grad_m1 = (dot(gp1, rotation[0]), dot(gp1, rotation[1]), dot(gp1, rotation[2]))
    px, py, pz = _camera_point_gradient(
        point, inverse_z, u, v, viewmat, fx, fy, grad_m0, grad_m1, grad_mean, g[splat.GRAD_DEPTH]
    )
    for k in range(3):
        grad_means[i, k] = viewmat[0, k] * px + viewmat[1, k] * py + viewmat[2, k] * pz


@strict_inner_function()
def _sum_over_tiles(pair_grads, pair_positions, first, last, total):
    """Add up the moments of one Gaussian's pairs, always in the same order, in double precision."""
    total[:] = 0.0
    for pair in range(first, last):
        ahead = pair_positions[min(pair + _PAIRS_AHEAD, pair_positions.size - 1)]
        prefetch(pair_grads, ahead * splat.GRAD_FLOATS)
        prefetch(pair_grads, ahead * splat.GRAD_FLOATS + splat.GRAD_FLOATS - 1)
        at = pair_positions[pair] * splat.GRAD_FLOATS
        for k in range(splat.GRAD_FLOATS):
            total[k] += pair_grads[at + k]


@strict_parallel_kernel()
def project_backward(
    gaussians, projection, pair_grads, pair_positions, pair_starts, grads, grad_means2d
):
    """Gather the gradient moments of each Gaussian and chain them back to its parameters; for the
    arguments not named here see ``project``.

    Args:
        pair_grads: moments per (tile, splat) pair, [P, 12].
        pair_positions, pair_starts: the pairs of Gaussian i are
            pair_positions[pair_starts[i]:pair_starts[i + 1]].
        grads: ``GaussianArrays``, filled, with 0 for the Gaussians without pairs.
        grad_means2d: filled likewise, [N, 2].
    """
    means, quats, scales, opacities, _ = gaussians
    viewmat, K, width, height, dilation = projection
    grad_means, grad_quats, grad_scales, grad_opacities, grad_features = grads
    count = means.shape[0]
    fx, fy = K[0, 0], K[1, 1]
    limits_u, limits_v = _slope_limits(fx, K[0, 2], width), _slope_limits(fy, K[1, 2], height)
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        g = np.empty(splat.GRAD_FLOATS)
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            if pair_starts[i] == pair_starts[i + 1]:
                grad_means[i], grad_quats[i], grad_scales[i], grad_means2d[i] = 0.0, 0.0, 0.0, 0.0
                grad_opacities[i], grad_features[i] = 0.0, 0.0
                continue
            _sum_over_tiles(
                address(pair_grads, 0), pair_positions, pair_starts[i], pair_starts[i + 1], g
            )
            for layer in range(2):
                opacity = opacities[i, layer]
                grad_opacities[i, layer] = (
                    g[splat.GRAD_LAYERS[layer]] / opacity if opacity > 0.0 else 0.0
                )
            for channel in range(3):
                grad_features[i, channel] = g[splat.GRAD_COLOR + 1 + channel]
            grad_features[i, 3] = g[splat.GRAD_SCALAR + 1]
            _geometry_gradient(
                i, g, means, quats, scales, viewmat, fx, fy, limits_u, limits_v, dilation,
                grad_means, grad_quats, grad_scales, grad_means2d,
            )  # fmt: skip
