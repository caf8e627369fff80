"""Exact k nearest neighbours on the device, in one Triton kernel behind a sort.

The points are sorted along a Z-order curve and cut into blocks, so that a block is small in space.
A program searches for the points of one block: it walks the blocks' bounding boxes, nearest first
within each chunk of them, and compares with the points of those that are not farther away than the
worst neighbour so far. Nothing is read back to the host, and the result is the same on every run.

A neighbour is an int64 key: the bits of the squared distance, which sort as the distance does,
above the index of the point. So the least key is the nearest point, and of several the one with the
lowest index.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor, nn

from mrgs.kernels.gpu_spec import Arguments, KernelSpec, specialised
from mrgs.kernels.neighbours import nearest_neighbours as nearest_neighbours_on_cpu
from mrgs.kernels.require import require

MAX_K = 16
"""More neighbours would not fit into a thread's registers."""

BLOCK = 32
"""Points per block and per program: smaller boxes skip more, larger ones share more."""

NUM_WARPS = 4
"""Fewer hold more keys each, and spill."""

CHUNK = 128
"""Boxes that are looked at together."""

FARTHEST = 1e18
"""Coordinates are clamped to it: the square of twice as much is still finite."""

BITS = 21
"""Number of bits of each coordinate in the Z-order code."""

SPREADING = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that leave two empty bits after each bit."""

INFINITE_BITS = tl.constexpr(0x7F800000)
NO_KEY = tl.constexpr(0x7FFFFFFFFFFFFFFF)
SLACK = tl.constexpr(0.99999)
"""Factor on a box's squared distance, which is rounded differently from distances between points:
the box must never seem farther away than its points."""


@triton.jit(do_not_specialize=("count", "blocks"))
def neighbours_kernel(
    points, originals, boxes, result, count, blocks,
    K: tl.constexpr, SLOTS: tl.constexpr, BLOCK: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """The K nearest others of each point of a block, nearest first.

    Args:
        points: sorted, [3, N].
        originals: each one's index, int32, [N].
        boxes: bounds of each block of points, the three lower, then the three upper, [6, M].
        result: receives the neighbours' indices, int64, [N, K]; the point's own where there are
            fewer others.
        count, blocks: N and M.
    """
    own = tl.program_id(0)
    queries = own * BLOCK + tl.arange(0, BLOCK)
    exists = queries < count
    x = tl.load(points + queries, mask=exists, other=0.0)
    y = tl.load(points + count + queries, mask=exists, other=0.0)
    z = tl.load(points + 2 * count + queries, mask=exists, other=0.0)
    itself = tl.load(originals + queries, mask=exists, other=-1)
    low_x, low_y = tl.load(boxes + own), tl.load(boxes + blocks + own)
    low_z = tl.load(boxes + 2 * blocks + own)
    high_x, high_y = tl.load(boxes + 3 * blocks + own), tl.load(boxes + 4 * blocks + own)
    high_z = tl.load(boxes + 5 * blocks + own)

    slots = tl.arange(0, SLOTS)[None, :] + tl.zeros((BLOCK, SLOTS), tl.int32)
    infinite = tl.full((BLOCK, SLOTS), INFINITE_BITS, tl.int64) << 32
    # A slot beyond K is never the worst; and nor are the slots of a query that does not exist.
    best = tl.where((slots < K) & exists[:, None], infinite | slots.to(tl.int64), -1)
    worst = tl.max(best, axis=1)
    limit = (tl.max(worst, axis=0) >> 32).to(tl.int32).to(tl.float32, bitcast=True)

    chunks = tl.cdiv(blocks, CHUNK)
    for step in range(chunks):
        first = (own // CHUNK + step) % chunks * CHUNK
        places = first + tl.arange(0, CHUNK)
        known = places < blocks
        gap_x = tl.maximum(
            tl.load(boxes + places, mask=known, other=0.0) - high_x,
            low_x - tl.load(boxes + 3 * blocks + places, mask=known, other=0.0),
        )
        gap_y = tl.maximum(
            tl.load(boxes + blocks + places, mask=known, other=0.0) - high_y,
            low_y - tl.load(boxes + 4 * blocks + places, mask=known, other=0.0),
        )
        gap_z = tl.maximum(
            tl.load(boxes + 2 * blocks + places, mask=known, other=0.0) - high_z,
            low_z - tl.load(boxes + 5 * blocks + places, mask=known, other=0.0),
        )
        gap_x, gap_y, gap_z = tl.maximum(gap_x, 0.0), tl.maximum(gap_y, 0.0), tl.maximum(gap_z, 0.0)
        gaps = tl.where(
            known, SLACK * (gap_x * gap_x + gap_y * gap_y + gap_z * gap_z), float("inf")
        )
        nearest = tl.min(gaps, axis=0)
        while (nearest <= limit) & (nearest < float("inf")):
            block = tl.min(tl.where(gaps == nearest, places, 0x7FFFFFFF), axis=0)
            gaps = tl.where(places == block, float("inf"), gaps)
            nearest = tl.min(gaps, axis=0)

            others = block * BLOCK + tl.arange(0, BLOCK)
            there = others < count
            dx = x[:, None] - tl.load(points + others, mask=there, other=0.0)[None, :]
            dy = y[:, None] - tl.load(points + count + others, mask=there, other=0.0)[None, :]
            dz = z[:, None] - tl.load(points + 2 * count + others, mask=there, other=0.0)[None, :]
            index = tl.load(originals + others, mask=there, other=-1)
            bits = (dx * dx + dy * dy + dz * dz).to(tl.int32, bitcast=True).to(tl.int64)
            is_other = there[None, :] & (index[None, :] != itself[:, None])
            keys = tl.where(is_other, (bits << 32) | index[None, :].to(tl.int64), NO_KEY)
            least = tl.min(keys, axis=1)
            while tl.max((least < worst).to(tl.int32), axis=0) > 0:
                replaced = (best == worst[:, None]) & (least < worst)[:, None]
                best = tl.where(replaced, least[:, None], best)
                keys = tl.where(keys == least[:, None], NO_KEY, keys)
                worst = tl.max(best, axis=1)
                least = tl.min(keys, axis=1)
            limit = (tl.max(worst, axis=0) >> 32).to(tl.int32).to(tl.float32, bitcast=True)

    best = tl.where(best < 0, NO_KEY, best)
    rows = result + itself.to(tl.int64) * K
    for slot in tl.static_range(K):
        least = tl.min(best, axis=1)
        best = tl.where(best == least[:, None], NO_KEY, best)
        index = tl.where((least >> 32) < INFINITE_BITS, least & 0xFFFFFFFF, itself.to(tl.int64))
        tl.store(rows + slot, index, mask=exists)


def nearest_neighbours(means: Tensor, k: int) -> Tensor:
    """``mrgs.field.heat.nearest_neighbours`` for float32, of several at the same distance the
    lowest index first; more than ``MAX_K`` are found on the host. A coordinate that is not finite
    counts as 1e18: to reject it, the host would have to wait for the device."""
    if k > MAX_K:
        return nearest_neighbours_on_cpu(means, k)
    require("means", means, (None, 3), device=means.device)
    count = len(means)
    itself = torch.arange(count, device=means.device)
    if k == 0 or count < 2:
        return itself[:, None].expand(count, k).contiguous()
    means = means.detach().nan_to_num(FARTHEST, FARTHEST, -FARTHEST).clamp(-FARTHEST, FARTHEST)
    order = _z_order(means).argsort(stable=True)
    points = means.index_select(0, order).T.contiguous()
    boxes = _boxes(points)
    result = torch.empty(count, k, dtype=torch.int64, device=means.device)
    given: Arguments = {
        "points": points, "originals": order.int(), "boxes": boxes, "result": result,
        "count": count, "blocks": boxes.shape[1],
    }  # fmt: skip
    _spec(k).launch((boxes.shape[1],), given)
    return result


def _z_order(means: Tensor) -> Tensor:
    """Place of each point along a Z-order curve through all of them, [N]."""
    low, high = means.amin(dim=0), means.amax(dim=0)
    cells = 2**BITS - 1
    span = (high - low).amax().clamp_min(torch.finfo(means.dtype).tiny)
    places = ((means - low) / span * cells).long().clamp_(0, cells)
    for shift, mask in SPREADING:
        places = (places | (places << shift)) & mask
    x, y, z = places.unbind(dim=1)
    return x | (y << 1) | (z << 2)


def _boxes(points: Tensor) -> Tensor:
    """The bounding box of each block of sorted points: [3, N] -> [6, M]."""
    missing = -points.shape[1] % BLOCK
    blocks = nn.functional.pad(points[None], (0, missing), mode="replicate")[0].unflatten(
        1, (-1, BLOCK)
    )
    return torch.cat([blocks.amin(dim=2), blocks.amax(dim=2)])


def _spec(k: int) -> KernelSpec:
    """The kernel for a number of neighbours."""
    types = {"originals": "*i32", "result": "*i64", "count": "i32", "blocks": "i32"}
    constants = {"K": k, "SLOTS": triton.next_power_of_2(k), "BLOCK": BLOCK, "CHUNK": CHUNK}
    return specialised(neighbours_kernel, constants, types, NUM_WARPS, variant=f"k={k}")


KERNELS = tuple(_spec(k) for k in (3, 8, 15))
