"""Order and tile lists: for each tile of 8×16 pixels the splats that reach it, nearest first. The
Gaussians are sorted by distance once; the lists are counted and filled in that order, so that no
(tile, distance) keys need sorting. Results do not depend on the number of threads."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from mrgs.errors import MrgsError
from mrgs.kernels.jit import address, strict_inner_function, strict_kernel, strict_parallel_kernel
from mrgs.kernels.simd import load, prefetch, store
from mrgs.rasterizer import splat

TILE_WIDTH = 8
TILE_HEIGHT = 16
CHUNKS = 16
"""Parts of the order that are counted and filled in parallel, whatever the number of threads."""

PREFETCH_AHEAD = 4
"""Records come in an unforeseeable order: each is prefetched this many turns before it is read."""

_CACHE_LINE = 64
"""Bytes of a record, too."""

_MOST_PAIRS = 2**31 - 1
"""The lists number pairs with 32 bits."""

_SLACK_PX = 1e-3
"""Widens the ellipse against rounding: a tile too many costs time, one too few a pixel."""

_RADIX_BITS = 11
_RADIX = 1 << _RADIX_BITS


@strict_kernel()
def nearest_first(distances, visible):
    """Indices of the visible Gaussians, nearest first, ties by index: a stable radix sort of the
    bits of float32 distances [N], which are positive where visible."""
    keys = distances.view(np.uint32)
    count = 0
    for i in range(visible.size):
        count += visible[i]
    order = np.empty(count, np.int32)
    filled = 0
    for i in range(visible.size):
        if visible[i]:
            order[filled] = i
            filled += 1
    target = np.empty(count, np.int32)
    for shift in range(0, 32, _RADIX_BITS):
        starts = np.zeros(_RADIX + 1, np.int64)
        for k in range(count):
            starts[((keys[order[k]] >> np.uint32(shift)) & np.uint32(_RADIX - 1)) + 1] += 1
        for digit in range(_RADIX):
            starts[digit + 1] += starts[digit]
        for k in range(count):
            digit = (keys[order[k]] >> np.uint32(shift)) & np.uint32(_RADIX - 1)
            target[starts[digit]] = order[k]
            starts[digit] += 1
        order, target = target, order
    return order


def empty_splats(count: int) -> np.ndarray:
    """Room for records, [N, 16], each in a cache line of its own; numpy's would lie across two."""
    floats = np.empty((count + 1) * splat.SPLAT_FLOATS, np.float32)
    first = -floats.ctypes.data % _CACHE_LINE // floats.itemsize
    return floats[first : first + count * splat.SPLAT_FLOATS].reshape(count, splat.SPLAT_FLOATS)


def gather_splats(splats: np.ndarray, order: np.ndarray) -> np.ndarray:
    """splats[order], in parallel."""
    gathered = empty_splats(order.size)
    _gather(splats, order, gathered)
    return gathered


@strict_parallel_kernel()
def _gather(splats, order, gathered):
    source, target = address(splats, 0), address(gathered, 0)
    for rank in prange(order.size):
        prefetch(source, order[min(rank + PREFETCH_AHEAD, order.size - 1)] * splat.SPLAT_FLOATS)
        store(target, rank * splat.SPLAT_FLOATS, load(source, order[rank] * splat.SPLAT_FLOATS))


@strict_inner_function()
def _tile_rows(record, tiles_y):
    """First and last row of tiles that the splat reaches (first > last if none)."""
    top = record[splat.MEAN_Y] - record[splat.EXTENT_Y] - _SLACK_PX
    bottom = record[splat.MEAN_Y] + record[splat.EXTENT_Y] + _SLACK_PX
    first = math.ceil(max(top - 0.5, 0.0))
    last = math.floor(min(bottom - 0.5, tiles_y * TILE_HEIGHT - 1.0))
    return int(first) // TILE_HEIGHT, (int(last) // TILE_HEIGHT if last >= first else -1)


@strict_inner_function()
def _half_width_at(record, dy):
    relative = dy / record[splat.EXTENT_Y]
    return record[splat.HALF_WIDTH] * math.sqrt(max(0.0, 1.0 - relative * relative))


@strict_inner_function()
def _tile_columns(record, tile_row, tiles_x):
    """First and last tile of a row of tiles that the ellipse α >= 1/255 reaches (first > last if
    none). The rightmost point within the row's band of pixel centres is the ellipse's own, or on
    the band's edge nearest to that; on the left likewise, where that point is mirrored."""
    band_top = tile_row * TILE_HEIGHT + 0.5 - record[splat.MEAN_Y]
    band_bottom = band_top + TILE_HEIGHT - 1.0
    sheared = record[splat.SHEAR] * record[splat.EXTENT_Y]
    reach = math.sqrt(record[splat.HALF_WIDTH] ** 2 + sheared * sheared)
    dy_rightmost = sheared * record[splat.EXTENT_Y] / reach
    dy = min(max(dy_rightmost, band_top), band_bottom)
    right = record[splat.MEAN_X] + record[splat.SHEAR] * dy + _half_width_at(record, dy) + _SLACK_PX
    dy = min(max(-dy_rightmost, band_top), band_bottom)
    left = record[splat.MEAN_X] + record[splat.SHEAR] * dy - _half_width_at(record, dy) - _SLACK_PX
    first = math.ceil(max(left - 0.5, 0.0))
    last = math.floor(min(right - 0.5, tiles_x * TILE_WIDTH - 1.0))
    return int(first) // TILE_WIDTH, (int(last) // TILE_WIDTH if last >= first else -1)


@strict_parallel_kernel()
def _count(splats, order, tiles_x, tiles_y, chunk_counts, pair_counts):
    """Pairs per (chunk, tile) and, where there is room for them, per Gaussian."""
    count = splats.shape[0]
    by_gaussian = pair_counts.size > 0
    for chunk in prange(CHUNKS):
        for rank in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            record = splats[rank]
            pairs = 0
            first_row, last_row = _tile_rows(record, tiles_y)
            for row in range(first_row, last_row + 1):
                first, last = _tile_columns(record, row, tiles_x)
                for column in range(first, last + 1):
                    chunk_counts[chunk, row * tiles_x + column] += 1
                    pairs += 1
            if by_gaussian:
                pair_counts[order[rank]] = pairs


@strict_kernel()
def _prefix_sums(chunk_counts, pair_counts):
    """Counts -> starts, in place for the chunks: tile after tile, in each the chunks in order."""
    tiles = chunk_counts.shape[1]
    tile_starts = np.empty(tiles + 1, np.int64)
    total = 0
    for tile in range(tiles):
        tile_starts[tile] = total
        for chunk in range(CHUNKS):
            pairs = chunk_counts[chunk, tile]
            chunk_counts[chunk, tile] = total
            total += pairs
    tile_starts[tiles] = total
    pair_starts = np.zeros(pair_counts.size + 1, np.int64)
    for i in range(pair_counts.size):
        pair_starts[i + 1] = pair_starts[i] + pair_counts[i]
    return tile_starts, pair_starts


@strict_parallel_kernel()
def _fill(splats, order, tiles_x, tiles_y, next_position, pair_starts, tile_splats, pair_positions):
    """Write the lists, and, where there is room, where each Gaussian's pairs are in them."""
    count = splats.shape[0]
    by_gaussian = pair_starts.size > 1
    for chunk in prange(CHUNKS):
        for rank in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            record = splats[rank]
            pair = pair_starts[order[rank]] if by_gaussian else 0
            first_row, last_row = _tile_rows(record, tiles_y)
            for row in range(first_row, last_row + 1):
                first, last = _tile_columns(record, row, tiles_x)
                for column in range(first, last + 1):
                    position = next_position[chunk, row * tiles_x + column]
                    next_position[chunk, row * tiles_x + column] += 1
                    tile_splats[position] = rank
                    if by_gaussian:
                        pair_positions[pair] = position
                    pair += 1


class TileLists(NamedTuple):
    """Which splats each tile draws, and where each Gaussian is drawn (P pairs of a tile and a
    splat).

    Attributes:
        tile_splats: splats of all tiles one after the other, int32 [P].
        tile_starts: the list of tile t is tile_splats[tile_starts[t]:tile_starts[t + 1]], int64
            [tiles + 1].
        pair_positions: positions in tile_splats of each Gaussian's pairs, one Gaussian after the
            other, int32 [P]; empty unless they were asked for.
        pair_starts: those of Gaussian i are pair_positions[pair_starts[i]:pair_starts[i + 1]],
            int64 [N + 1]; [1] unless they were asked for.
    """

    tile_splats: np.ndarray
    tile_starts: np.ndarray
    pair_positions: np.ndarray
    pair_starts: np.ndarray


def tile_lists(
    splats: np.ndarray, order: np.ndarray, gaussians: int, width: int, height: int
) -> TileLists:
    """The tile lists of the splats [V, 16], nearest first, which are those of the Gaussians
    ``order`` [V] of N = ``gaussians``; 0 if their pairs are not wanted, which gradients need.
    MrgsError if there are more pairs than the lists can number."""
    tiles_x, tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    chunk_counts = np.zeros((CHUNKS, tiles_x * tiles_y), np.int64)
    pair_counts = np.zeros(gaussians, np.int32)
    _count(splats, order, tiles_x, tiles_y, chunk_counts, pair_counts)
    tile_starts, pair_starts = _prefix_sums(chunk_counts, pair_counts)
    if tile_starts[-1] > _MOST_PAIRS:
        raise MrgsError(
            f"the Gaussians reach {tile_starts[-1]:,} tiles of the image together, and at most "
            f"{_MOST_PAIRS:,} can be drawn: render a smaller image, or fewer Gaussians"
        )
    tile_splats = np.empty(tile_starts[-1], np.int32)
    pair_positions = np.empty(pair_starts[-1], np.int32)
    _fill(splats, order, tiles_x, tiles_y, chunk_counts, pair_starts, tile_splats, pair_positions)
    return TileLists(tile_splats, tile_starts, pair_positions, pair_starts)
