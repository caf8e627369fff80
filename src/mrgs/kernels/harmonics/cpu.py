"""Spherical harmonics of Gaussians seen from a camera: SH2RGB of Eq. 4, where clamped at 0."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.field import spherical_harmonics as sh
from mrgs.kernels.dense import SHARES
from mrgs.kernels.jit import address, reordering_inner_function, reordering_parallel_kernel
from mrgs.kernels.require import listed, require

_ZERO = np.float32(0)
_HALF = np.float32(0.5)
_TWO, _THREE, _FOUR, _SIX, _EIGHT = (np.float32(value) for value in (2, 3, 4, 6, 8))
_C0, _C1 = np.float32(sh.C0), np.float32(sh.C1)
_C2, _C2_ZONAL = np.float32(sh.C2), np.float32(sh.C2_ZONAL)
_C3_ORDER1, _C3_ORDER2, _C3_ORDER3, _C3_ZONAL = (
    np.float32(factor) for factor in (sh.C3_ORDER1, sh.C3_ORDER2, sh.C3_ORDER3, sh.C3_ZONAL)
)
SMALLEST_DISTANCE = np.float32(1e-12)


def shade(
    means: Float[Tensor, "n 3"],
    dc: Float[Tensor, "n 1 c"],
    rest: Float[Tensor, "n b c"],
    camera_position: Float[Tensor, "3"],
    degree: int,
    rows: Int64[Tensor, " v"] | None = None,
    floor: float = 0.0,
) -> Float[Tensor, "v c"]:
    """``mrgs.field.spherical_harmonics.shade``; all tensors but ``rows`` are float32. ValueError
    for tensors of other sizes or types, or harmonics above degree 3; IndexError for rows beyond."""
    count, channels = len(means), dc.shape[-1]
    require("means", means, (count, 3))
    require("dc", dc, (count, 1, channels))
    require("rest", rest, (count, None, channels))
    require("camera_position", camera_position, (3,))
    rows = listed(rows, count)
    bands = min((degree + 1) ** 2 - 1, rest.shape[1])
    if bands > sh.MOST_BANDS:
        raise ValueError(f"there are at most {sh.MOST_BANDS} bands of harmonics, not {bands}")
    floors = (np.float32(floor),) * channels
    shaded: Tensor = _Shade.apply(means, dc, rest, camera_position, bands, rows, floors)
    return shaded


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        means, dc, rest, camera_position, bands, rows, floors = inputs
        tensors = [tensor.contiguous() for tensor in (means, dc, rest, camera_position, rows)]
        values = np.empty((len(rows), dc.shape[2]), np.float32)
        is_clamped = np.empty(values.shape, np.bool_)
        _forward(*(each.detach().numpy() for each in tensors), bands, floors, values, is_clamped)
        ctx.save_for_backward(*tensors, torch.from_numpy(is_clamped))
        ctx.bands, ctx.floors = bands, floors
        return torch.from_numpy(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved = [tensor.detach().numpy() for tensor in ctx.saved_tensors]
        gradients = [np.zeros(array.shape, np.float32) for array in saved[:3]]
        _backward(*saved, ctx.bands, ctx.floors, grads[0].contiguous().numpy(), *gradients)
        means, dc, rest = (torch.from_numpy(array) for array in gradients)
        if ctx.bands == 0:
            return None, dc, rest if rest.shape[1] else None, None, None, None, None
        camera = -means.sum(dim=0) if ctx.needs_input_grad[3] else None
        return means, dc, rest, camera, None, None, None


# The kernels take a floor for each channel: the length of a tuple is known to the compiler, which
# unrolls the loops over the channels.


@reordering_parallel_kernel
def _forward(means, dc, rest, camera, rows, bands, floors, values, is_clamped):
    for share in prange(SHARES):
        basis, value = np.zeros(15, np.float32), np.zeros(len(floors), np.float32)
        for place in range(
            np.int64(share) * rows.size // SHARES, (np.int64(share) + 1) * rows.size // SHARES
        ):
            row = rows[place]
            x, y, z, _ = direction(means, camera, row)
            _set_basis(x, y, z, bands, basis)
            _sum_harmonics(dc, rest, row, basis, bands, value, floors)
            for channel in range(len(floors)):
                below = value[channel] < floors[channel]  # so NaN stays
                is_clamped[place, channel] = below
                values[place, channel] = floors[channel] if below else value[channel]


@reordering_inner_function
def _sum_harmonics(dc, rest, row, basis, bands, value, floors):
    """Σ coefficients × basis + ½ of each channel."""
    channels = len(floors)
    constant, higher = address(dc, row * channels), address(rest, row * rest.shape[1] * channels)
    sums = address(value, 0)
    for channel in range(channels):
        sums[channel] = _C0 * constant[channel] + _HALF
    for band in range(bands):
        for channel in range(channels):
            sums[channel] += basis[band] * higher[band * channels + channel]


@reordering_parallel_kernel
def _backward(
    means, dc, rest, camera, rows, is_clamped, bands, floors, grad, grad_means, grad_dc, grad_rest
):
    for share in prange(SHARES):
        basis, weights = np.zeros(15, np.float32), np.zeros(15, np.float32)
        g = np.zeros(len(floors), np.float32)
        for place in range(
            np.int64(share) * rows.size // SHARES, (np.int64(share) + 1) * rows.size // SHARES
        ):
            row = rows[place]
            for channel in range(len(floors)):
                g[channel] = _ZERO if is_clamped[place, channel] else grad[place, channel]
                grad_dc[row, 0, channel] = _C0 * g[channel]
            if bands > 0:
                x, y, z, inverse = direction(means, camera, row)
                _set_basis(x, y, z, bands, basis)
                _spread_gradient(rest, row, basis, bands, g, grad_rest, weights, floors)
                toward = _basis_gradient(x, y, z, weights, bands)
                add_direction_gradient(x, y, z, inverse, toward, grad_means, row)


@reordering_inner_function
def _spread_gradient(rest, row, basis, bands, g, grad_rest, weights, floors):
    """The gradients of a Gaussian's coefficients, and of the basis functions (``weights``)."""
    channels = len(floors)
    at = row * rest.shape[1] * channels
    higher, grad_higher, of_channel = address(rest, at), address(grad_rest, at), address(g, 0)
    for band in range(bands):
        weight = _ZERO
        for channel in range(channels):
            grad_higher[band * channels + channel] = basis[band] * of_channel[channel]
            weight += higher[band * channels + channel] * of_channel[channel]
        weights[band] = weight


@reordering_inner_function
def direction(means, camera, row):
    """The unit vector from the camera to a Gaussian, and 1 / distance."""
    x, y, z = means[row, 0] - camera[0], means[row, 1] - camera[1], means[row, 2] - camera[2]
    inverse = np.float32(1) / max(math.sqrt(x * x + y * y + z * z), SMALLEST_DISTANCE)
    return x * inverse, y * inverse, z * inverse, inverse


@reordering_inner_function
def add_direction_gradient(x, y, z, inverse, grad, grad_means, row):
    """Add (I − d dᵀ) g / distance, the gradient of a unit direction d, to that of the mean."""
    along = x * grad[0] + y * grad[1] + z * grad[2]
    grad_means[row, 0] += inverse * (grad[0] - along * x)
    grad_means[row, 1] += inverse * (grad[1] - along * y)
    grad_means[row, 2] += inverse * (grad[2] - along * z)


@reordering_inner_function
def _set_basis(x, y, z, bands, basis):
    """The 15 basis functions of degrees 1 to 3, of which only ``bands`` are set."""
    xx, yy, zz = x * x, y * y, z * z
    if bands >= 3:
        basis[0], basis[1], basis[2] = -_C1 * y, _C1 * z, -_C1 * x
    if bands >= 8:
        basis[3], basis[4], basis[6] = _C2 * x * y, -_C2 * y * z, -_C2 * x * z
        basis[5] = _C2_ZONAL * (_TWO * zz - xx - yy)
        basis[7] = _HALF * _C2 * (xx - yy)
    if bands >= 15:
        basis[8] = -_C3_ORDER3 * y * (_THREE * xx - yy)
        basis[9] = _C3_ORDER2 * x * y * z
        basis[10] = -_C3_ORDER1 * y * (_FOUR * zz - xx - yy)
        basis[11] = _C3_ZONAL * z * (_TWO * zz - _THREE * xx - _THREE * yy)
        basis[12] = -_C3_ORDER1 * x * (_FOUR * zz - xx - yy)
        basis[13] = _HALF * _C3_ORDER2 * z * (xx - yy)
        basis[14] = -_C3_ORDER3 * x * (xx - _THREE * yy)


@reordering_inner_function
def _basis_gradient(x, y, z, weights, bands):
    """∂/∂(x, y, z) of Σ weights × basis; weights beyond ``bands`` are 0."""
    gx, gy, gz = -_C1 * weights[2], -_C1 * weights[0], _C1 * weights[1]
    if bands >= 8:
        w0, w1, w3, w4 = _C2 * weights[3], -_C2 * weights[4], -_C2 * weights[6], _C2 * weights[7]
        w2 = _TWO * _C2_ZONAL * weights[5]
        gx += w0 * y - w2 * x + w3 * z + w4 * x
        gy += w0 * x + w1 * z - w2 * y - w4 * y
        gz += w1 * y + _TWO * w2 * z + w3 * x
    if bands >= 15:
        cubic = _basis_gradient_of_degree_three(x, y, z, weights)
        gx, gy, gz = gx + cubic[0], gy + cubic[1], gz + cubic[2]
    return gx, gy, gz


@reordering_inner_function
def _basis_gradient_of_degree_three(x, y, z, weights):
    xx, yy, zz = x * x, y * y, z * z
    w0, w1, w2 = -_C3_ORDER3 * weights[8], _C3_ORDER2 * weights[9], -_C3_ORDER1 * weights[10]
    w3, w4 = _C3_ZONAL * weights[11], -_C3_ORDER1 * weights[12]
    w5, w6 = _C3_ORDER2 * weights[13], -_C3_ORDER3 * weights[14]
    gx = (
        w0 * _SIX * x * y + w1 * y * z - w2 * _TWO * x * y - w3 * _SIX * x * z
        + w4 * (_FOUR * zz - _THREE * xx - yy) + w5 * x * z + w6 * _THREE * (xx - yy)
    )  # fmt: skip
    gy = (
        w0 * _THREE * (xx - yy) + w1 * x * z + w2 * (_FOUR * zz - xx - _THREE * yy)
        - w3 * _SIX * y * z
        - w4 * _TWO * x * y - w5 * y * z - w6 * _SIX * x * y
    )  # fmt: skip
    gz = (
        w1 * x * y + w2 * _EIGHT * y * z + w3 * (_SIX * zz - _THREE * (xx + yy))
        + w4 * _EIGHT * x * z + _HALF * w5 * (xx - yy)
    )  # fmt: skip
    return gx, gy, gz
