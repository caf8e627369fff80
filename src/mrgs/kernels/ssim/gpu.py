"""The losses that compare images, for float32 on a GPU: nothing here makes the host wait."""

from __future__ import annotations

from functools import partial

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from mrgs.kernels import ssim as ssim_losses
from mrgs.kernels.gpu_spec import Arguments, KernelSpec, specialised
from mrgs.kernels.require import require
from mrgs.kernels.ssim import Dissimilarity, Scalars
from mrgs.method.losses.ssim import RADIUS_PX, WEIGHTS

BLOCK = 128
"""Values of a row per program."""

STRIP_ROWS = 16
"""Rows per program, which reads ten more: long strips repeat less, short ones fill the device."""

NUM_WARPS = 4

RADIUS = tl.constexpr(RADIUS_PX)
TAPS = tl.constexpr(2 * RADIUS_PX + 1)
WINDOW = tuple(WEIGHTS.tolist())

SIZES = ("height", "width", "channels", "weights_pitch")
"""Arguments that do not trigger a recompilation in Triton."""

SCALARS = ("dssim", "l1", "c1", "c2", "steepness", "half_width")
TYPES = dict.fromkeys(SIZES, "i32") | dict.fromkeys(SCALARS, "fp32")


@triton.jit
def _no_sums(BLOCK: tl.constexpr):
    zero = tl.zeros((BLOCK,), tl.float32)
    return zero, zero, zero, zero, zero, zero, zero, zero, zero, zero


@triton.jit
def _enter(sums, value, WINDOW: tl.constexpr):
    """A row enters the window's begun sums: the sum that it completes, and the next ten."""
    a, b, c = WINDOW[0] * value, WINDOW[1] * value, WINDOW[2] * value
    d, e, f = WINDOW[3] * value, WINDOW[4] * value, WINDOW[5] * value
    begun = (
        sums[1] + b, sums[2] + c, sums[3] + d, sums[4] + e, sums[5] + f,
        sums[6] + e, sums[7] + d, sums[8] + c, sums[9] + b, a,
    )  # fmt: skip
    return sums[0] + a, begun


@triton.jit
def _huber_slope(difference, steepness):
    """The derivative of the Huber loss; of |x − y|, its sign."""
    return tl.minimum(tl.maximum(steepness * difference, -1.0), 1.0)


@triton.jit(do_not_specialize=SIZES)
def compare_kernel(
    x, y, weights, derivatives, errors, totals, height, width, channels, weights_pitch,
    dssim, l1, c1, c2, steepness, half_width,
    WINDOW: tl.constexpr, STRIP_ROWS: tl.constexpr, BLOCK: tl.constexpr, BY_Y: tl.constexpr,
):  # fmt: skip
    """Derivatives of Σ weights dssim (1 − SSIM) by the moments, and each program's part of the
    whole sum.

    Args:
        x, y: the images, [H, W·C].
        weights: of each pixel, [H, W], or [1, W] with a pitch of 0; where 0, both images are read
            as 0.
        derivatives: receives them, [3 + BY_Y, H, W·C].
        errors: receives 1 − SSIM of each value, [H, W·C]; None if not wanted.
        totals: receives Σ weights (l1 H(x − y) + dssim (1 − SSIM)) of each program, with H the
            Huber loss, [rows of the grid, its columns].
        height, width, channels: H, W, C.
        weights_pitch: W, or 0 for one row of weights.
        dssim, l1, c1, c2, steepness, half_width: see ``ssim.Compare``.
    """
    columns = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    nothing = tl.zeros((BLOCK,), tl.int32)  # the interpreter cannot broadcast the truth of one row
    first = tl.program_id(1) * STRIP_ROWS
    row_values = width * channels
    plane = height * row_values
    in_row = columns < row_values
    own_pixels = columns // channels
    sums_x, sums_squares = _no_sums(BLOCK), _no_sums(BLOCK)
    sums_product, sums_y = _no_sums(BLOCK), _no_sums(BLOCK)
    total = tl.zeros((BLOCK,), tl.float32)
    for row in range(
        tl.maximum(first - RADIUS, 0), tl.minimum(first + STRIP_ROWS, height) + RADIUS
    ):
        rows = row + nothing
        in_image = in_row & (rows < height)
        at, weights_at = rows * row_values + columns, rows * weights_pitch + own_pixels
        along_x, along_squares = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
        along_product, along_y = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
        for tap in tl.static_range(TAPS):
            pixels = own_pixels + (tap - RADIUS)
            mask = in_image & (pixels >= 0) & (pixels < width)
            mask &= tl.load(weights + weights_at + (tap - RADIUS), mask=mask, other=0.0) != 0
            a = tl.load(x + at + (tap - RADIUS) * channels, mask=mask, other=0.0)
            b = tl.load(y + at + (tap - RADIUS) * channels, mask=mask, other=0.0)
            weighed_a, weighed_b = WINDOW[tap] * a, WINDOW[tap] * b
            along_x += weighed_a
            along_y += weighed_b
            along_squares += weighed_a * a + weighed_b * b
            along_product += weighed_a * b
        mean_x, sums_x = _enter(sums_x, along_x, WINDOW)
        mean_y, sums_y = _enter(sums_y, along_y, WINDOW)
        squares, sums_squares = _enter(sums_squares, along_squares, WINDOW)
        product, sums_product = _enter(sums_product, along_product, WINDOW)

        rows -= RADIUS
        mask = in_row & (rows >= first) & (rows < height)
        at = rows * row_values + columns
        weight = tl.load(weights + rows * weights_pitch + own_pixels, mask=mask, other=0.0)
        a = tl.load(x + at, mask=mask & (weight != 0), other=0.0)
        b = tl.load(y + at, mask=mask & (weight != 0), other=0.0)
        cross, both = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
        per_means, per_variances = 1.0 / (both + c1), 1.0 / (squares - both + c2)
        luminance = (2.0 * cross + c1) * per_means
        structure = (2.0 * (product - cross) + c2) * per_variances
        error = 1.0 - luminance * structure
        # A row that is not this strip's may hold half a window: it counts nothing, not even NaN.
        slope = _huber_slope(a - b, steepness)
        huber = slope * (a - b - half_width * slope)
        total += tl.where(mask, weight * (l1 * huber + dssim * error), 0.0)
        if errors is not None:
            tl.store(errors + at, error, mask=mask)
        scale = -2.0 * dssim * weight
        by_means, by_variances = scale * structure * per_means, scale * luminance * per_variances
        by_mean_x = by_means * (mean_y - luminance * mean_x) + by_variances * (
            structure * mean_x - mean_y
        )
        tl.store(derivatives + at, by_mean_x, mask=mask)
        tl.store(derivatives + plane + at, -by_variances * structure, mask=mask)
        tl.store(derivatives + 2 * plane + at, by_variances, mask=mask)
        if BY_Y:
            by_mean_y = by_means * (mean_x - luminance * mean_y) + by_variances * (
                structure * mean_y - mean_x
            )
            tl.store(derivatives + 3 * plane + at, by_mean_y, mask=mask)
    tl.store(
        totals + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0), tl.sum(total, axis=0)
    )


@triton.jit(do_not_specialize=SIZES)
def gradients_kernel(
    x, y, weights, derivatives, gradient_x, gradient_y, height, width, channels, weights_pitch,
    l1, steepness, WINDOW: tl.constexpr, STRIP_ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The gradients by the images from the derivatives by the moments, and L1's own.

    Args:
        derivatives: as ``compare_kernel`` stored them; for the arguments not named here see there.
        gradient_x: receives the gradient by x, [H, W·C].
        gradient_y: receives the gradient by y; None if not wanted.
    """
    columns = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    nothing = tl.zeros((BLOCK,), tl.int32)  # the interpreter cannot broadcast the truth of one row
    first = tl.program_id(1) * STRIP_ROWS
    row_values = width * channels
    plane = height * row_values
    in_row = columns < row_values
    own_pixels = columns // channels
    sums_x, sums_squares = _no_sums(BLOCK), _no_sums(BLOCK)
    sums_product, sums_y = _no_sums(BLOCK), _no_sums(BLOCK)
    for row in range(
        tl.maximum(first - RADIUS, 0), tl.minimum(first + STRIP_ROWS, height) + RADIUS
    ):
        rows = row + nothing
        in_image = in_row & (rows < height)
        at = rows * row_values + columns
        along_x, along_squares = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
        along_product, along_y = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
        for tap in tl.static_range(TAPS):
            pixels = own_pixels + (tap - RADIUS)
            mask = in_image & (pixels >= 0) & (pixels < width)
            values = derivatives + at + (tap - RADIUS) * channels
            along_x += WINDOW[tap] * tl.load(values, mask=mask, other=0.0)
            along_squares += WINDOW[tap] * tl.load(values + plane, mask=mask, other=0.0)
            along_product += WINDOW[tap] * tl.load(values + 2 * plane, mask=mask, other=0.0)
            if gradient_y is not None:
                along_y += WINDOW[tap] * tl.load(values + 3 * plane, mask=mask, other=0.0)
        by_mean_x, sums_x = _enter(sums_x, along_x, WINDOW)
        by_squares, sums_squares = _enter(sums_squares, along_squares, WINDOW)
        by_product, sums_product = _enter(sums_product, along_product, WINDOW)
        by_mean_y, sums_y = _enter(sums_y, along_y, WINDOW)

        rows -= RADIUS
        mask = in_row & (rows >= first) & (rows < height)
        at = rows * row_values + columns
        weight = tl.load(weights + rows * weights_pitch + own_pixels, mask=mask, other=0.0)
        counts = weight != 0
        a = tl.load(x + at, mask=mask & counts, other=0.0)
        b = tl.load(y + at, mask=mask & counts, other=0.0)
        step = l1 * weight * _huber_slope(a - b, steepness)
        gradient = step + by_mean_x + a * by_squares + b * by_product
        tl.store(gradient_x + at, tl.where(counts, gradient, 0.0), mask=mask)
        if gradient_y is not None:
            gradient = by_mean_y + b * by_squares + a * by_product - step
            tl.store(gradient_y + at, tl.where(counts, gradient, 0.0), mask=mask)


def _specs(by_y: bool, wants_errors: bool) -> tuple[KernelSpec, KernelSpec]:
    """Both kernels, with or without what only S-SSIM needs: unwanted tensors are None."""
    blocks = {"WINDOW": WINDOW, "STRIP_ROWS": STRIP_ROWS, "BLOCK": BLOCK}
    compared = {**blocks, "BY_Y": by_y} | ({} if wants_errors else {"errors": None})
    differentiated = blocks | ({} if by_y else {"gradient_y": None})
    variant = "structure" if by_y else "l1_dssim"
    return (
        specialised(compare_kernel, compared, TYPES, NUM_WARPS, variant=variant),
        specialised(gradients_kernel, differentiated, TYPES, NUM_WARPS, variant=variant),
    )


KERNELS = (*_specs(False, False), *_specs(True, True))
"""L1 and SSIM of a render and a photo; and S-SSIM, whose gradient both images ask for."""


def compare(
    x: Float[Tensor, "h w c"],
    y: Float[Tensor, "h w c"],
    weights: Float[Tensor, "h2 w"],
    scalars: Scalars,
    wants_errors: bool,
) -> Dissimilarity:
    """``ssim.Compare`` for float32 images, without a host round trip; the total is of float64.
    ValueError for tensors of other sizes, types or devices."""
    require("x", x, (None, None, None), device=x.device)
    require("y", y, x.shape, device=x.device)
    rows = 1 if len(weights) == 1 else len(x)
    require("weights", weights, (rows, x.shape[1]), device=x.device)
    by_x, by_y = x.requires_grad, y.requires_grad
    x, y, weights = (tensor.detach().contiguous() for tensor in (x, y, weights))
    height, width, channels = x.shape
    grid = (triton.cdiv(width * channels, BLOCK), triton.cdiv(height, STRIP_ROWS))
    gradient_x, gradient_y = torch.empty_like(x), torch.empty_like(y) if by_y else None
    given: Arguments = {
        "x": x, "y": y, "weights": weights,
        "derivatives": x.new_empty(3 + by_y, height, width * channels),
        "errors": torch.empty_like(x) if wants_errors else None,
        "totals": x.new_empty(grid[1], grid[0]),
        "gradient_x": gradient_x, "gradient_y": gradient_y,
    }  # fmt: skip
    sizes = (height, width, channels, 0 if len(weights) == 1 else width)
    given |= dict(zip((*SIZES, *SCALARS), (*sizes, *scalars), strict=True))
    for spec in _specs(by_y, wants_errors):
        spec.launch(grid, given)
    total = given["totals"].sum(dtype=torch.float64)
    return Dissimilarity(total, gradient_x if by_x else None, gradient_y, given["errors"])


photometric_loss = partial(ssim_losses.photometric_loss, compare)
boltzmann_loss = partial(ssim_losses.boltzmann_loss, compare)
