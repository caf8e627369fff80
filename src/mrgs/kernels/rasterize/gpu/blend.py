"""Alpha blending of the tiles: one warp per tile walks its list front to back, all layers in one
walk.

    α_i = min(0.999, o_i G_i),  w_i = α_i T_i,
    image = Σ w_i f_i + T_end · background,  depth = Σ w_i z_i

The records of the list lie all over the memory: each is loaded one splat ahead, and its place in
the memory two splats ahead, so that loads and arithmetic overlap.
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
    """The record of a splat: geometry and depth, and of each layer opacity and features (0 for one
    that is not there)."""
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
            tl.load(record + COLOR),
            tl.load(record + COLOR + 1),
            tl.load(record + COLOR + 2),
            tl.load(record + COLOR + 3),
        )
    if HAS_SCALAR:
        scalar = (tl.load(record + SCALAR), tl.load(record + SCALAR + 1))
    return geometry, color, scalar


@device_function
def gaussian_at(geometry, centre_x, centre_y):
    """The projected Gaussian G' at pixels, and their offsets: dx from the midline of its ellipse,
    and dy."""
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
        tl.store(
            image_color + 3 * pixel, red + passed_color * tl.load(background_color), mask=inside
        )
        tl.store(
            image_color + 3 * pixel + 1,
            green + passed_color * tl.load(background_color + 1),
            mask=inside,
        )
        tl.store(
            image_color + 3 * pixel + 2,
            blue + passed_color * tl.load(background_color + 2),
            mask=inside,
        )
        _store_coverage(
            depth_color, alpha_color, transmittance_color, pixel, inside, z_color, passed_color
        )
    if HAS_SCALAR:
        tl.store(
            image_scalar + pixel, heat + passed_scalar * tl.load(background_scalar), mask=inside
        )
        _store_coverage(
            depth_scalar,
            alpha_scalar,
            transmittance_scalar,
            pixel,
            inside,
            z_scalar,
            passed_scalar,
        )


@device_function
def _store_coverage(depth, alpha, transmittance, pixel, inside, z, passed):
    tl.store(depth + pixel, z, mask=inside)
    tl.store(alpha + pixel, 1.0 - passed, mask=inside)
    tl.store(transmittance + pixel, passed, mask=inside)
