"""Which tiles a splat reaches: counted by ``projection.project`` and listed by ``list_pairs``.

A pair is a tile and a splat that reaches it. The pairs are numbered Gaussian by Gaussian, nearest
first; sorted by tile, with a stable sort, they are the lists of the tiles in that order.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mrgs.kernels.gpu_spec import device_function
from mrgs.kernels.rasterize.gpu.constants import (
    EXTENT_Y,
    HALF_WIDTH,
    MEAN_X,
    MEAN_Y,
    SHEAR,
    SLACK_PX,
    SPLAT_FLOATS,
    TILE_HEIGHT,
    TILE_WIDTH,
)


@device_function
def tile_rows(mean_y, extent_y, height):
    """First and last row of tiles that the ellipse α >= 1/255 reaches (first > last if none)."""
    top = mean_y - extent_y - SLACK_PX
    bottom = mean_y + extent_y + SLACK_PX
    first = tl.ceil(tl.maximum(top - 0.5, 0.0)).to(tl.int32)
    last = tl.floor(tl.minimum(bottom - 0.5, height - 1.0)).to(tl.int32)
    return first // TILE_HEIGHT, tl.where(last >= first, last // TILE_HEIGHT, -1)


@device_function
def _half_width_at(half_width, extent_y, dy):
    relative = dy / extent_y
    return half_width * tl.sqrt(tl.maximum(1.0 - relative * relative, 0.0))


@device_function
def tile_columns(mean_x, mean_y, shear, extent_y, half_width, tile_row, width):
    """First tile of a row of tiles that the ellipse α >= 1/255 reaches, and how many. The rightmost
    point within the row's band of pixel centres is the ellipse's own, or on the band's edge nearest
    to that; on the left likewise, where that point is mirrored."""
    band_top = (tile_row * TILE_HEIGHT).to(tl.float32) + 0.5 - mean_y
    band_bottom = band_top + (TILE_HEIGHT - 1.0)
    sheared = shear * extent_y
    dy_rightmost = sheared * extent_y / tl.sqrt(half_width * half_width + sheared * sheared)
    dy = tl.minimum(tl.maximum(dy_rightmost, band_top), band_bottom)
    right = mean_x + shear * dy + _half_width_at(half_width, extent_y, dy) + SLACK_PX
    dy = tl.minimum(tl.maximum(-dy_rightmost, band_top), band_bottom)
    left = mean_x + shear * dy - _half_width_at(half_width, extent_y, dy) - SLACK_PX
    first = tl.ceil(tl.maximum(left - 0.5, 0.0)).to(tl.int32)
    last = tl.floor(tl.minimum(right - 0.5, width - 1.0)).to(tl.int32)
    tiles = tl.where(last >= first, last // TILE_WIDTH - first // TILE_WIDTH + 1, 0)
    return first // TILE_WIDTH, tiles


@device_function
def count_pairs(visible, mean_x, mean_y, shear, extent_y, half_width, width, height):
    """How many tiles each splat of a block reaches."""
    first_row, last_row = tile_rows(mean_y, extent_y, height)
    rows = tl.where(visible, last_row - first_row + 1, 0)
    pairs = tl.zeros_like(rows)
    step, steps = 0, tl.max(rows, axis=0)
    while step < steps:
        _, tiles = tile_columns(
            mean_x, mean_y, shear, extent_y, half_width, first_row + step, width
        )
        pairs += tl.where(step < rows, tiles, 0)
        step += 1
    return pairs


@device_function
def _rank_of_pair(pair, pair_ends, count):
    """The first rank whose pairs end behind the pair, by bisection."""
    low = tl.zeros_like(pair)
    high = low + (count - 1)
    left = count - 1  # at most this many ranks are between low and high
    while left > 0:
        middle = (low + high) // 2
        is_before = tl.load(pair_ends + middle) <= pair
        low = tl.where(is_before, middle + 1, low)
        high = tl.where(is_before, high, middle)
        left = left // 2
    return low


@triton.jit(do_not_specialize=["pairs", "count", "width", "height"])
def list_pairs(
    splats, order, pair_ends, tile_of_pair, splat_of_pair, pairs, count, width, height,
    BLOCK: tl.constexpr
):  # fmt: skip
    """Write the tile and the splat of every pair, one thread per pair, so that a large splat costs
    no more than many.

    Should rounding give a splat fewer tiles than were counted, the rest gets a tile past the last,
    which none draws; so does what a list has room for beyond its pairs.

    Args:
        splats: records, [N, 16].
        order: splats, nearest first, int64 [N].
        pair_ends: cumulated counts of pairs in this order, int64 [N].
        tile_of_pair, splat_of_pair: filled, [P], the first of any integer type.
        pairs, count: P, the room of the list, and N.
    """
    pair = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pair < pairs
    listed = tl.load(pair_ends + count - 1).to(tl.int32)
    rank = _rank_of_pair(tl.minimum(pair, listed - 1), pair_ends, count)
    before = pair - tl.load(pair_ends + rank - 1, mask=rank > 0, other=0).to(tl.int32)
    index = tl.load(order + rank).to(tl.int32)
    record = splats + index * SPLAT_FLOATS
    mean_x, mean_y = tl.load(record + MEAN_X), tl.load(record + MEAN_Y)
    shear = tl.load(record + SHEAR)
    extent_y, half_width = tl.load(record + EXTENT_Y), tl.load(record + HALF_WIDTH)
    tiles_x, tiles_y = tl.cdiv(width, TILE_WIDTH), tl.cdiv(height, TILE_HEIGHT)
    row, last_row = tile_rows(mean_y, extent_y, height)
    tile = tl.zeros_like(row) + tiles_x * tiles_y
    searching = (pair < listed) & (row <= last_row)
    while tl.max(searching.to(tl.int32), axis=0) > 0:
        first, tiles = tile_columns(mean_x, mean_y, shear, extent_y, half_width, row, width)
        tile = tl.where(searching & (before < tiles), row * tiles_x + first + before, tile)
        searching = searching & (before >= tiles) & (row < last_row)
        before -= tiles
        row += 1
    tl.store(tile_of_pair + pair, tile.to(tile_of_pair.dtype.element_ty), mask=inside)
    tl.store(splat_of_pair + pair, index, mask=inside)
