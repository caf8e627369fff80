"""Alpha blending of the tiles: one warp per tile walks its list front to back, all layers in one
walk.

    α_i = min(0.999, o_i G_i),  w_i = α_i T_i,
    image = Σ w_i f_i + T_end · background,  depth = Σ w_i z_i

The records of the list lie all over the memory: each is loaded one turn before it is needed, and
its place in the memory two turns before, so that the loads of a turn and the arithmetic of the one
before overlap.
"""

from __future__ import annotations

import triton
import triton.language as tl

from mrgs.kernels.rasterize.gpu.constants import (
    ACROSS,
    ALONG,
    ALPHA_MAX,
    ALPHA_MIN,
    DEPTH,
    MEAN_X,
    MEAN_Y,
    RGB,
    SHEAR,
    SPLAT_FLOATS,
    THERMAL,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_WIDTH,
    TRANSMITTANCE_MIN,
)
from mrgs.kernels.rasterize.gpu.jit import device_function

TURNS = tl.constexpr(2)
"""So many splats are blended between two looks at whether any pixel of the tile is still
unfinished. The code of these turns stands one after the other, so that the loads of one need not
wait for the registers of the one before."""


@device_function
def tile_pixels(tile, width, height):
    """Columns and rows of the tile's pixels, and which of them lie in the image."""
    index = tl.arange(0, TILE_PIXELS)
    tiles_x = tl.cdiv(width, TILE_WIDTH)
    column = tile % tiles_x * TILE_WIDTH + index % TILE_WIDTH
    row = tile // tiles_x * TILE_HEIGHT + index // TILE_WIDTH
    return column, row, (column < width) & (row < height)


@device_function
def load_splat(splats, index, exists, HAS_RGB: tl.constexpr, HAS_THERMAL: tl.constexpr):
    """The record of a splat: geometry and depth, and of each layer opacity and features (0 for one
    that is not there).

    Past the end of the list there is none: the last one is repeated, and is transparent.
    """
    record = splats + index * SPLAT_FLOATS
    geometry = (
        tl.load(record + MEAN_X), tl.load(record + MEAN_Y),
        tl.load(record + ACROSS), tl.load(record + SHEAR), tl.load(record + ALONG),
        tl.load(record + DEPTH),
    )  # fmt: skip
    rgb = (0.0, 0.0, 0.0, 0.0)
    thermal = (0.0, 0.0)
    if HAS_RGB:
        opacity = tl.where(exists, tl.load(record + RGB), 0.0)
        rgb = (
            opacity,
            tl.load(record + RGB + 1),
            tl.load(record + RGB + 2),
            tl.load(record + RGB + 3),
        )
    if HAS_THERMAL:
        thermal = (tl.where(exists, tl.load(record + THERMAL), 0.0), tl.load(record + THERMAL + 1))
    return geometry, rgb, thermal


@device_function
def gaussian_at(geometry, dx, dy):
    """The projected Gaussian G' at offsets from its centre."""
    across = dx - geometry[3] * dy
    return tl.exp2(geometry[2] * across * across + geometry[4] * dy * dy)


@device_function
def blended_alpha(gaussian, opacity, transmittance):
    """α before it is clamped; and α, or 0 where the splat does not blend."""
    unclamped = opacity * gaussian
    blends = (unclamped >= ALPHA_MIN) & (transmittance >= TRANSMITTANCE_MIN)
    return unclamped, tl.where(blends, tl.minimum(unclamped, ALPHA_MAX), 0.0)


@device_function
def any_unfinished(transmittance_rgb, transmittance_thermal):
    """Whether some pixel of the tile lets light through in some layer."""
    largest = tl.maximum(transmittance_rgb, transmittance_thermal)
    return tl.max((largest >= TRANSMITTANCE_MIN).to(tl.int32), axis=0) > 0


@triton.jit(do_not_specialize=["width", "height"])
def blend(
    splats, tile_splats, tile_starts, background_rgb, background_thermal,
    image_rgb, depth_rgb, alpha_rgb, transmittance_rgb,
    image_thermal, depth_thermal, alpha_thermal, transmittance_thermal, width, height,
    HAS_RGB: tl.constexpr, HAS_THERMAL: tl.constexpr,
):  # fmt: skip
    """Fill the images of the layers: features [H, W, C], depth, alpha and T_end [H, W].

    Args:
        splats: records, [N, 16].
        tile_splats, tile_starts: splats of all tiles, int32 [P], and where each tile's begin, int32
            [tiles + 1].
        background_rgb, background_thermal: [3] and [1].
    """
    tile = tl.program_id(0)
    position, last = tl.load(tile_starts + tile), tl.load(tile_starts + tile + 1)
    column, row, inside = tile_pixels(tile, width, height)
    centre_x, centre_y = column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5
    zero = tl.zeros([TILE_PIXELS], tl.float32)
    passed_rgb, red, green, blue, z_rgb = zero, zero, zero, zero, zero
    passed_thermal, heat, z_thermal = zero, zero, zero
    if HAS_RGB:
        passed_rgb = tl.where(inside, 1.0, zero)
    if HAS_THERMAL:
        passed_thermal = tl.where(inside, 1.0, zero)
    unfinished = position < last
    following = tl.load(tile_splats + position, mask=unfinished, other=0)
    splat = load_splat(splats, following, unfinished, HAS_RGB, HAS_THERMAL)
    following = tl.load(tile_splats + tl.minimum(position + 1, last - 1), mask=unfinished, other=0)
    while unfinished:
        for _ in tl.static_range(TURNS):
            geometry, rgb, thermal = splat
            position += 1
            splat = load_splat(splats, following, position < last, HAS_RGB, HAS_THERMAL)
            following = tl.load(tile_splats + tl.minimum(position + 1, last - 1))
            gaussian = gaussian_at(geometry, centre_x - geometry[0], centre_y - geometry[1])
            if HAS_RGB:
                _, alpha = blended_alpha(gaussian, rgb[0], passed_rgb)
                weight = alpha * passed_rgb
                passed_rgb -= weight
                z_rgb += weight * geometry[5]
                red += weight * rgb[1]
                green += weight * rgb[2]
                blue += weight * rgb[3]
            if HAS_THERMAL:
                _, alpha = blended_alpha(gaussian, thermal[0], passed_thermal)
                weight = alpha * passed_thermal
                passed_thermal -= weight
                z_thermal += weight * geometry[5]
                heat += weight * thermal[1]
        unfinished = (position < last) & any_unfinished(passed_rgb, passed_thermal)
    pixel = row * width + column
    if HAS_RGB:
        tl.store(image_rgb + 3 * pixel, red + passed_rgb * tl.load(background_rgb), mask=inside)
        tl.store(
            image_rgb + 3 * pixel + 1, green + passed_rgb * tl.load(background_rgb + 1), mask=inside
        )
        tl.store(
            image_rgb + 3 * pixel + 2, blue + passed_rgb * tl.load(background_rgb + 2), mask=inside
        )
        _store_coverage(depth_rgb, alpha_rgb, transmittance_rgb, pixel, inside, z_rgb, passed_rgb)
    if HAS_THERMAL:
        tl.store(
            image_thermal + pixel, heat + passed_thermal * tl.load(background_thermal), mask=inside
        )
        _store_coverage(
            depth_thermal,
            alpha_thermal,
            transmittance_thermal,
            pixel,
            inside,
            z_thermal,
            passed_thermal,
        )


@device_function
def _store_coverage(depth, alpha, transmittance, pixel, inside, z, passed):
    tl.store(depth + pixel, z, mask=inside)
    tl.store(alpha + pixel, 1.0 - passed, mask=inside)
    tl.store(transmittance + pixel, passed, mask=inside)
