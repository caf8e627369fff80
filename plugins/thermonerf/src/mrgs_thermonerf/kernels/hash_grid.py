"""Multi-resolution hash encoding: trilinear interpolation (Müller et al. 2022, Section 3)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels.jit import inner_function, parallel_kernel
from mrgs.kernels.require import require
from mrgs_thermonerf.networks import CHANNELS, PRIMES

_SHARES = 4
"""Parts that the points of a level are cut into for the threads."""

_BLOCK = 64
"""Points whose corners are found together, so that the compiler can use vectors."""

_PRIME_Y, _PRIME_Z = np.uint32(PRIMES[1]), np.uint32(PRIMES[2])
"""Of the spatial hash; x is not multiplied, so that neighbours along it lie close together."""


def encode(
    points: Float[Tensor, "n 3"],
    table: Float[Tensor, "entries 4"],
    resolutions: Int64[Tensor, " levels"],
    offsets: Int64[Tensor, " levels+1"],
) -> Float[Tensor, "n 4*levels"]:
    """``mrgs_thermonerf.networks.encode`` for float32 or float64 on the CPU. ValueError
    for tensors of other sizes or types, or levels that do not lie in the table."""
    levels = len(resolutions)
    require("points", points, (None, 3), (torch.float32, torch.float64))
    require("table", table, (None, CHANNELS), (points.dtype,))
    require("resolutions", resolutions, (levels,), (torch.int64,))
    require("offsets", offsets, (levels + 1,), (torch.int64,))
    first = offsets.tolist()
    if first[0] < 0 or first[-1] > len(table) or any(a >= b for a, b in pairwise(first)):
        raise ValueError(f"offsets must ascend from 0 to {len(table)}, not {first}")
    features: Tensor = _Encode.apply(points, table, resolutions, offsets)
    return features


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, table: Tensor, resolutions: Tensor, offsets: Tensor
    ) -> Tensor:
        points, table = points.detach().contiguous(), table.detach().contiguous()
        ctx.save_for_backward(points, resolutions, offsets)
        ctx.entries = len(table)
        features = points.new_empty(len(points), CHANNELS * len(resolutions))
        _forward(
            points.numpy(), table.numpy(), resolutions.numpy(), offsets.numpy(), features.numpy()
        )
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        points, resolutions, offsets = ctx.saved_tensors
        grad_table = points.new_zeros(ctx.entries, CHANNELS)
        grad = grads[0].contiguous()
        _backward(
            points.numpy(), resolutions.numpy(), offsets.numpy(), grad.numpy(), grad_table.numpy()
        )
        return None, grad_table, None, None


@inner_function
def _locate(points, first, rows, resolution, size, entries, weights):
    """Entries and trilinear weights of the corners around each point of a block, [8, block]."""
    corners, hash_mask = np.uint32(resolution + 1), np.uint32(size - 1)
    is_dense = (resolution + 1) ** 3 <= size
    scale, one, zero = points.dtype.type(resolution), points.dtype.type(1), points.dtype.type(0)
    for row in range(rows):
        px = min(max(points[first + row, 0], zero), one) * scale
        py = min(max(points[first + row, 1], zero), one) * scale
        pz = min(max(points[first + row, 2], zero), one) * scale
        cx, cy, cz = (
            min(np.floor(px), scale - one),
            min(np.floor(py), scale - one),
            min(np.floor(pz), scale - one),
        )
        fx, fy, fz = px - cx, py - cy, pz - cz
        x, y, z = np.uint32(cx), np.uint32(cy), np.uint32(cz)
        for corner in range(8):
            i, j, k = np.uint32(corner & 1), np.uint32((corner >> 1) & 1), np.uint32(corner >> 2)
            if is_dense:
                entry = (x + i) + corners * ((y + j) + corners * (z + k))
                entries[corner, row] = min(
                    entry, np.uint32(size - 1)
                )  # a NaN gets an entry, if any
            else:
                entries[corner, row] = (
                    (x + i) ^ ((y + j) * _PRIME_Y) ^ ((z + k) * _PRIME_Z)
                ) & hash_mask
            weights[corner, row] = (
                (fx if i else one - fx) * (fy if j else one - fy) * (fz if k else one - fz)
            )


@parallel_kernel
def _forward(points, table, resolutions, offsets, features):
    # Level after level, so that a table stays in the cache.
    for share in prange(resolutions.size * _SHARES):
        level, part = np.int64(share) // _SHARES, np.int64(share) % _SHARES
        first, end = part * len(points) // _SHARES, (part + 1) * len(points) // _SHARES
        level_table = table[offsets[level] : offsets[level + 1]]
        _forward_level(
            points, level_table, resolutions[level], first, end, features[:, CHANNELS * level :]
        )


@inner_function
def _forward_level(points, table, resolution, first, end, features):
    entries, weights = np.empty((8, _BLOCK), np.uint32), np.empty((8, _BLOCK), points.dtype)
    zero = points.dtype.type(0)
    for start in range(first, end, _BLOCK):
        rows = min(_BLOCK, end - start)
        _locate(points, start, rows, resolution, len(table), entries, weights)
        for row in range(rows):
            a = b = c = d = zero
            for corner in range(8):
                weight, entry = weights[corner, row], np.uintp(entries[corner, row])
                a += weight * table[entry, 0]
                b += weight * table[entry, 1]
                c += weight * table[entry, 2]
                d += weight * table[entry, 3]
            features[start + row, 0] = a
            features[start + row, 1] = b
            features[start + row, 2] = c
            features[start + row, 3] = d


@parallel_kernel
def _backward(points, resolutions, offsets, grad, grad_table):
    # One thread for each table: nothing is atomic, and the order is fixed.
    for level in prange(resolutions.size):
        level_table = grad_table[offsets[level] : offsets[level + 1]]
        _backward_level(
            points, resolutions[level], grad[:, CHANNELS * np.int64(level) :], level_table
        )


@inner_function
def _backward_level(points, resolution, grad, grad_table):
    entries, weights = np.empty((8, _BLOCK), np.uint32), np.empty((8, _BLOCK), points.dtype)
    for start in range(0, len(points), _BLOCK):
        rows = min(_BLOCK, len(points) - start)
        _locate(points, start, rows, resolution, len(grad_table), entries, weights)
        for row in range(rows):
            a, b = grad[start + row, 0], grad[start + row, 1]
            c, d = grad[start + row, 2], grad[start + row, 3]
            for corner in range(8):
                weight, entry = weights[corner, row], np.uintp(entries[corner, row])
                grad_table[entry, 0] += weight * a
                grad_table[entry, 1] += weight * b
                grad_table[entry, 2] += weight * c
                grad_table[entry, 3] += weight * d
