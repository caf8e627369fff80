"""Alpha blending of the tiles and its backward: one warp per tile walks its list front to back, all
layers in one walk.

    α_i = min(0.999, o_i G_i),  w_i = α_i T_i,
    image = Σ w_i f_i + T_end · background,  depth = Σ w_i z_i

The records of the list are scattered over the memory: each is loaded one splat ahead, and its place
in the memory two splats ahead, so that loads and arithmetic overlap.

Backward is the same walk with one running scalar per layer and pixel. With g the gradient of a
pixel, let R_i = Σ_{j>i} w_j (g·f_j) + T_end (g·background − g_alpha): all that is behind the splat
i. Then ∂L/∂α_i = T_i (g·f_i) − R_i / (1 − α_i). R starts as g·pixel − T_end g_alpha and loses w_i
(g·f_i) at each step; nothing is divided by T. Every (tile, splat) pair has its own record of sums,
in the order in which ``tiles.list_pairs`` numbered them: those of one splat are side by side,
``sum_pairs`` adds them up, and no atomics are needed. The result is the same bits on every run.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mrgs.kernels.gpu_spec import device_function
from mrgs.kernels.rasterize.gpu.constants import (
    ACROSS,
    ALONG,
    ALPHA_MAX,
    ALPHA_MIN,
    COLOR,
    DEPTH,
    GRAD_ACROSS,
    GRAD_ACROSS_ACROSS,
    GRAD_ACROSS_DY,
    GRAD_COLOR,
    GRAD_DEPTH,
    GRAD_DY,
    GRAD_DY_DY,
    GRAD_FLOATS,
    GRAD_SCALAR,
    MEAN_X,
    MEAN_Y,
    SCALAR,
    SHEAR,
    SPLAT_FLOATS,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_WIDTH,
    TRANSMITTANCE_MIN,
)
from mrgs.kernels.rasterize.gpu.projection import store_three


@device_function
def tile_pixels(tile, width, height):
    """Columns and rows of the tile's pixels, and which of them lie in the image."""
    index = tl.arange(0, TILE_PIXELS)
    tiles_x = tl.cdiv(width, TILE_WIDTH)
    column = tile % tiles_x * TILE_WIDTH + index % TILE_WIDTH
    row = tile // tiles_x * TILE_HEIGHT + index // TILE_WIDTH
    return column, row, (column < width) & (row < height)


@device_function
def load_splat(splats, index, HAS_COLOR: tl.constexpr, HAS_SCALAR: tl.constexpr):
    """A splat's record: geometry, depth, and each layer's opacity and features (0 if absent)."""
    record = splats + index * SPLAT_FLOATS
    geometry = (
        tl.load(record + MEAN_X), tl.load(record + MEAN_Y),
        tl.load(record + ACROSS), tl.load(record + SHEAR), tl.load(record + ALONG),
        tl.load(record + DEPTH),
    )  # fmt: skip
    color = (0.0, 0.0, 0.0, 0.0)
    scalar = (0.0, 0.0)
    if HAS_COLOR:
        color = (
            tl.load(record + COLOR), tl.load(record + COLOR + 1),
            tl.load(record + COLOR + 2), tl.load(record + COLOR + 3),
        )  # fmt: skip
    if HAS_SCALAR:
        scalar = (tl.load(record + SCALAR), tl.load(record + SCALAR + 1))
    return geometry, color, scalar


@device_function
def gaussian_at(geometry, centre_x, centre_y):
    """The projected Gaussian G' at pixels; dx from the midline of its ellipse, and dy."""
    dy = centre_y - geometry[1]
    across = centre_x - geometry[0] - geometry[3] * dy
    return tl.exp2(geometry[2] * across * across + geometry[4] * dy * dy), across, dy


@device_function
def blended_alpha(gaussian, opacity, transmittance):
    """α before it is clamped; and α, or 0 where the splat does not blend."""
    unclamped = opacity * gaussian
    blends = (unclamped >= ALPHA_MIN) & (transmittance >= TRANSMITTANCE_MIN)
    return unclamped, tl.where(blends, tl.minimum(unclamped, ALPHA_MAX), 0.0)


@device_function
def any_unfinished(transmittance_color, transmittance_scalar):
    """Whether some pixel of the tile lets light through in some layer."""
    largest = tl.maximum(transmittance_color, transmittance_scalar)
    return tl.max((largest >= TRANSMITTANCE_MIN).to(tl.int32), axis=0) > 0


@triton.jit(do_not_specialize=["width", "height"])
def blend(
    splats, tile_splats, tile_starts, background_color, background_scalar,
    image_color, depth_color, alpha_color, transmittance_color,
    image_scalar, depth_scalar, alpha_scalar, transmittance_scalar, width, height,
    HAS_COLOR: tl.constexpr, HAS_SCALAR: tl.constexpr,
):  # fmt: skip
    """Fill the images of the layers: features [H, W, C], depth, alpha and T_end [H, W].

    Args:
        splats: records, [N, 16].
        tile_splats, tile_starts: splats of all tiles, int32 [P], and where each tile's begin, int32
            [tiles + 1].
        background_color, background_scalar: [3] and [1].
    """
    tile = tl.program_id(0)
    position, last = tl.load(tile_starts + tile), tl.load(tile_starts + tile + 1)
    column, row, inside = tile_pixels(tile, width, height)
    centre_x, centre_y = column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5
    zero = tl.zeros([TILE_PIXELS], tl.float32)
    passed_color, red, green, blue, z_color = zero, zero, zero, zero, zero
    passed_scalar, heat, z_scalar = zero, zero, zero
    if HAS_COLOR:
        passed_color = tl.where(inside, 1.0, zero)
    if HAS_SCALAR:
        passed_scalar = tl.where(inside, 1.0, zero)
    unfinished = position < last
    following = tl.load(tile_splats + position, mask=unfinished, other=0)
    splat = load_splat(splats, following, HAS_COLOR, HAS_SCALAR)
    following = tl.load(tile_splats + tl.minimum(position + 1, last - 1), mask=unfinished, other=0)
    while unfinished:
        geometry, color, scalar = splat
        position += 1
        splat = load_splat(splats, following, HAS_COLOR, HAS_SCALAR)
        following = tl.load(tile_splats + tl.minimum(position + 1, last - 1))
        gaussian, _, _ = gaussian_at(geometry, centre_x, centre_y)
        if HAS_COLOR:
            _, alpha = blended_alpha(gaussian, color[0], passed_color)
            weight = alpha * passed_color
            passed_color -= weight
            z_color += weight * geometry[5]
            red += weight * color[1]
            green += weight * color[2]
            blue += weight * color[3]
        if HAS_SCALAR:
            _, alpha = blended_alpha(gaussian, scalar[0], passed_scalar)
            weight = alpha * passed_scalar
            passed_scalar -= weight
            z_scalar += weight * geometry[5]
            heat += weight * scalar[1]
        unfinished = (position < last) & any_unfinished(passed_color, passed_scalar)
    pixel = row * width + column
    if HAS_COLOR:
        color = (
            red + passed_color * tl.load(background_color),
            green + passed_color * tl.load(background_color + 1),
            blue + passed_color * tl.load(background_color + 2),
        )
        store_three(image_color, pixel, inside, color)
        _store_coverage(
            depth_color, alpha_color, transmittance_color, pixel, inside, z_color, passed_color
        )
    if HAS_SCALAR:
        heat += passed_scalar * tl.load(background_scalar)
        tl.store(image_scalar + pixel, heat, mask=inside)
        _store_coverage(
            depth_scalar, alpha_scalar, transmittance_scalar, pixel, inside, z_scalar, passed_scalar
        )


@device_function
def _store_coverage(depth, alpha, transmittance, pixel, inside, z, passed):
    tl.store(depth + pixel, z, mask=inside)
    tl.store(alpha + pixel, 1.0 - passed, mask=inside)
    tl.store(transmittance + pixel, passed, mask=inside)


PADDED_FLOATS = tl.constexpr(16)
"""``GRAD_FLOATS``, and up to a power of two: what a tensor of Triton's can hold."""


@device_function
def _load_coverage(depth, transmittance, grad_depth, grad_alpha, pixel, inside):
    """T_end, the gradient of the depth, and what depth and alpha add to R at its start."""
    passed = tl.load(transmittance + pixel, mask=inside, other=0.0)
    grad = tl.load(grad_depth + pixel, mask=inside, other=0.0)
    behind = grad * tl.load(depth + pixel, mask=inside, other=0.0)
    return passed, grad, behind - passed * tl.load(grad_alpha + pixel, mask=inside, other=0.0)


@device_function
def _load_channel(image, grad_image, grad_background, at, inside, passed, tile):
    """The gradient of a channel, and what it adds to R's start and to the background's gradient."""
    grad = tl.load(grad_image + at, mask=inside, other=0.0)
    tl.store(grad_background + tile, tl.sum(passed * grad, axis=0))
    return grad, grad * tl.load(image + at, mask=inside, other=0.0)


@device_function
def _grad_log_alpha(unclamped, alpha, own, behind):
    """α ∂L/∂α = w (g·f) − R α / (1 − α): 0 where the splat does not blend, or α is clamped."""
    root = tl.rsqrt(1.0 - alpha)  # of [0.001, 1]: a division would guard against what cannot be
    return tl.where(unclamped < ALPHA_MAX, own - behind * (alpha * root * root), 0.0)


@device_function
def _with_sum(sums, field: tl.constexpr, values):
    """The record with the sum of the values over the pixels as one of its fields."""
    return tl.where(tl.arange(0, PADDED_FLOATS) == field, tl.sum(values, axis=0), sums)


@device_function
def _sum_geometry(sums, grad, across, dy):
    """Moments of α ∂L/∂α over the pixels' offsets."""
    grad_across, grad_dy = grad * across, grad * dy
    sums = _with_sum(sums, GRAD_ACROSS, grad_across)
    sums = _with_sum(sums, GRAD_DY, grad_dy)
    sums = _with_sum(sums, GRAD_ACROSS_ACROSS, grad_across * across)
    sums = _with_sum(sums, GRAD_ACROSS_DY, grad_across * dy)
    return _with_sum(sums, GRAD_DY_DY, grad_dy * dy)


@triton.jit(do_not_specialize=["tiles", "width", "height"])
def blend_backward(
    splats, tile_splats, tile_starts, tile_pairs,
    image_color, depth_color, transmittance_color, image_scalar, depth_scalar, transmittance_scalar,
    grad_image_color, grad_depth_color, grad_alpha_color, grad_image_scalar, grad_depth_scalar,
    grad_alpha_scalar,
    pair_grads, grad_backgrounds, tiles, width, height, HAS_COLOR: tl.constexpr,
    HAS_SCALAR: tl.constexpr,
):  # fmt: skip
    """Write the gradient moments of every pair that blends; the others' must be 0 beforehand.

    Args:
        splats: records, [N, 16].
        tile_splats, tile_pairs, tile_starts: splats of all tiles, int32 [P], the numbers of their
            pairs, int64 [P], and where each tile's begin, int32 [tiles + 1].
        image_color, ..., transmittance_scalar: what ``blend`` wrote.
        grad_*: the gradients of its images.
        pair_grads: written, [P, 12].
        grad_backgrounds: filled, [4, tiles]: red, green, blue and temperature of each tile.
    """
    tile = tl.program_id(0)
    position, last = tl.load(tile_starts + tile), tl.load(tile_starts + tile + 1)
    column, row, inside = tile_pixels(tile, width, height)
    centre_x, centre_y = column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5
    pixel = row * width + column
    fields = tl.arange(0, PADDED_FLOATS)
    zero = tl.zeros([TILE_PIXELS], tl.float32)
    passed_color, passed_scalar = zero, zero
    if HAS_COLOR:
        passed_color, gz_color, behind_color = _load_coverage(
            depth_color, transmittance_color, grad_depth_color, grad_alpha_color, pixel, inside
        )
        grads, image = grad_backgrounds + tile, grad_image_color
        gr, more = _load_channel(image_color, image, grads, 3 * pixel, inside, passed_color, 0)
        behind_color += more
        gg, more = _load_channel(
            image_color, image, grads, 3 * pixel + 1, inside, passed_color, tiles
        )
        behind_color += more
        gb, more = _load_channel(
            image_color, image, grads, 3 * pixel + 2, inside, passed_color, 2 * tiles
        )
        behind_color += more
        passed_color = tl.where(inside, 1.0, zero)
    if HAS_SCALAR:
        passed_scalar, gz_scalar, behind_scalar = _load_coverage(
            depth_scalar, transmittance_scalar, grad_depth_scalar, grad_alpha_scalar, pixel, inside
        )
        grads = grad_backgrounds + tile
        gt, more = _load_channel(
            image_scalar, grad_image_scalar, grads, pixel, inside, passed_scalar, 3 * tiles
        )
        behind_scalar += more
        passed_scalar = tl.where(inside, 1.0, zero)
    unfinished = position < last
    following = tl.load(tile_splats + position, mask=unfinished, other=0)
    splat = load_splat(splats, following, HAS_COLOR, HAS_SCALAR)
    following = tl.load(tile_splats + tl.minimum(position + 1, last - 1), mask=unfinished, other=0)
    while unfinished:
        geometry, color, scalar = splat
        pair = tl.load(tile_pairs + position)
        position += 1
        splat = load_splat(splats, following, HAS_COLOR, HAS_SCALAR)
        following = tl.load(tile_splats + tl.minimum(position + 1, last - 1))
        gaussian, across, dy = gaussian_at(geometry, centre_x, centre_y)
        sums = tl.zeros([PADDED_FLOATS], tl.float32)
        grad, grad_z = zero, zero
        if HAS_COLOR:
            unclamped, alpha = blended_alpha(gaussian, color[0], passed_color)
            weight = alpha * passed_color
            passed_color -= weight
            own = weight * (gz_color * geometry[5] + gr * color[1] + gg * color[2] + gb * color[3])
            behind_color -= own
            grad = _grad_log_alpha(unclamped, alpha, own, behind_color)
            grad_z = weight * gz_color
            sums = _with_sum(sums, GRAD_COLOR, grad)
            sums = _with_sum(sums, GRAD_COLOR + 1, weight * gr)
            sums = _with_sum(sums, GRAD_COLOR + 2, weight * gg)
            sums = _with_sum(sums, GRAD_COLOR + 3, weight * gb)
        if HAS_SCALAR:
            unclamped, alpha = blended_alpha(gaussian, scalar[0], passed_scalar)
            weight = alpha * passed_scalar
            passed_scalar -= weight
            own = weight * (gz_scalar * geometry[5] + gt * scalar[1])
            behind_scalar -= own
            grad_scalar = _grad_log_alpha(unclamped, alpha, own, behind_scalar)
            grad += grad_scalar
            grad_z += weight * gz_scalar
            sums = _with_sum(sums, GRAD_SCALAR, grad_scalar)
            sums = _with_sum(sums, GRAD_SCALAR + 1, weight * gt)
        sums = _with_sum(_sum_geometry(sums, grad, across, dy), GRAD_DEPTH, grad_z)
        tl.store(pair_grads + pair * GRAD_FLOATS + fields, sums, mask=fields < GRAD_FLOATS)
        unfinished = (position < last) & any_unfinished(passed_color, passed_scalar)


@triton.jit(do_not_specialize=["count"])
def sum_pairs(
    pair_grads, pair_ends, order, gaussian_grads, count, RANKS: tl.constexpr, PAIRS: tl.constexpr
):
    """Add up the moments of each Gaussian's pairs, always in the same order; 0 for a Gaussian
    without.

    A program takes several ranks of the order at once, and of each several pairs at once.

    Args:
        pair_grads: [P, 12].
        pair_ends, order: cumulated counts of pairs, nearest first, and the Gaussians in this order,
            int64 [N].
        gaussian_grads: filled, [N, 12].
    """
    rank = tl.program_id(0) * RANKS + tl.arange(0, RANKS)
    inside = rank < count
    first = tl.load(pair_ends + rank - 1, mask=inside & (rank > 0), other=0)
    pairs = (tl.load(pair_ends + rank, mask=inside, other=0) - first).to(tl.int32)
    fields = tl.arange(0, PADDED_FLOATS)
    within = tl.arange(0, PAIRS)
    is_field = fields < GRAD_FLOATS
    total = tl.zeros([RANKS, PAIRS, PADDED_FLOATS], tl.float32)
    begin, most = 0, tl.max(pairs, axis=0)
    while begin < most:
        is_pair = begin + within[None, :] < pairs[:, None]
        at = (first[:, None] + begin + within[None, :]) * GRAD_FLOATS
        mask = is_pair[:, :, None] & is_field[None, None, :]
        total += tl.load(pair_grads + at[:, :, None] + fields[None, None, :], mask=mask, other=0.0)
        begin += PAIRS
    sums = tl.sum(total, axis=1)
    row = tl.load(order + rank, mask=inside, other=0) * GRAD_FLOATS
    tl.store(
        gaussian_grads + row[:, None] + fields[None, :],
        sums,
        mask=inside[:, None] & is_field[None, :],
    )
