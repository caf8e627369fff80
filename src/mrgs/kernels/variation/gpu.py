"""Total variation of an image with its gradient, in one Triton kernel.

As in ``mrgs.kernels.variation.cpu``: a pixel's gradient is the two steps that lead to it less the
two that leave it, where a step is the weight of a difference with the difference's sign. Sums are
taken in a fixed order.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from mrgs.kernels.gpu_spec import Arguments, KernelSpec
from mrgs.kernels.known_gradient import with_gradients
from mrgs.kernels.require import require
from mrgs.kernels.variation import valid_pairs

BLOCK = 512
"""Values per program."""

NUM_WARPS = 4
SIZES = ("height", "width", "channels")
SCALES = ("row_scale", "column_scale")
WEIGHTS = ("row_weights", "column_weights")


@triton.jit(do_not_specialize=SIZES)
def variation_kernel(
    image, row_weights, column_weights, gradient, totals, height, width, channels,
    row_scale, column_scale, BLOCK: tl.constexpr,
):  # fmt: skip
    """Σ scale weight |first difference| of each program's values, to the next row and to the next
    column.

    Args:
        image: [H, W, C].
        row_weights: of the differences between neighbouring rows, [H − 1, W]; None for 1.
        column_weights: of the differences between neighbouring columns, [H, W − 1]; None for 1.
        gradient: receives the gradient, [H, W, C].
        totals: receives each program's part of the sum.
        height, width, channels: H, W, C.
        row_scale, column_scale: of all differences between rows, and between columns.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row_values = width * channels
    mask = at < height * row_values
    row, column = at // row_values, at % row_values // channels
    has_above, has_below = mask & (row > 0), mask & (row + 1 < height)
    has_left, has_right = mask & (column > 0), mask & (column + 1 < width)

    above = tl.where(has_above, row_scale, 0.0)
    below = tl.where(has_below, row_scale, 0.0)
    if row_weights is not None:
        weight_at = row_weights + row * width + column
        above *= tl.load(weight_at - width, mask=has_above, other=0.0)
        below *= tl.load(weight_at, mask=has_below, other=0.0)
    left = tl.where(has_left, column_scale, 0.0)
    right = tl.where(has_right, column_scale, 0.0)
    if column_weights is not None:
        weight_at = column_weights + row * (width - 1) + column
        left *= tl.load(weight_at - 1, mask=has_left, other=0.0)
        right *= tl.load(weight_at, mask=has_right, other=0.0)

    value = tl.load(image + at, mask=mask, other=0.0)
    from_above = value - tl.load(image + at - row_values, mask=has_above, other=0.0)
    to_below = tl.load(image + at + row_values, mask=has_below, other=0.0) - value
    from_left = value - tl.load(image + at - channels, mask=has_left, other=0.0)
    to_right = tl.load(image + at + channels, mask=has_right, other=0.0) - value
    arriving = tl.where(from_above > 0, above, tl.where(from_above < 0, -above, 0.0))
    arriving += tl.where(from_left > 0, left, tl.where(from_left < 0, -left, 0.0))
    leaving = tl.where(to_below > 0, below, tl.where(to_below < 0, -below, 0.0))
    leaving += tl.where(to_right > 0, right, tl.where(to_right < 0, -right, 0.0))
    tl.store(gradient + at, arriving - leaving, mask=mask)
    total = tl.where(has_below, below * tl.abs(to_below), 0.0) + tl.where(
        has_right, right * tl.abs(to_right), 0.0
    )
    tl.store(totals + tl.program_id(0), tl.sum(total, axis=0))


def total_variation(
    image: Tensor,
    valid: Tensor | None = None,
    row_weights: Tensor | None = None,
    column_weights: Tensor | None = None,
) -> Tensor:
    """``mrgs.method.losses.smoothness.total_variation`` for float32; the host does not wait.

    Raises:
        ValueError: tensors of other sizes, types or devices.
    """
    require("image", image, (None, None, None), device=image.device)
    weights: list[Tensor | None] = []
    scales = []
    for axis, of_axis in enumerate((row_weights, column_weights)):
        counted, pairs = valid_pairs(image, axis, valid, of_axis)
        if isinstance(counted, Tensor):  # only the device knows it
            assert pairs is not None
            weights.append(pairs / (image.shape[2] * counted).clamp_min(1))
            scales.append(1.0)
        else:
            weights.append(pairs)
            scales.append(1 / max(image.shape[2] * counted, 1))
    pixels, programs = image.detach().contiguous(), triton.cdiv(image.numel(), BLOCK)
    gradient = torch.empty_like(pixels)
    tensors = (pixels, *(None if each is None else each.contiguous() for each in weights), gradient)
    given: Arguments = dict(zip(("image", *WEIGHTS, "gradient"), tensors, strict=True))
    given |= dict(zip((*SIZES, *SCALES), (*image.shape, *scales), strict=True))
    given["totals"] = image.new_empty(programs)
    _spec([name for name in WEIGHTS if given[name] is None]).launch((programs,), given)
    return with_gradients(given["totals"].sum(dtype=torch.float64), [image], [gradient])


def _spec(left_out: Sequence[str]) -> KernelSpec:
    """The kernel without some of the weights."""
    tensors = ("image", "gradient", "totals", *(name for name in WEIGHTS if name not in left_out))
    signature = dict.fromkeys(tensors, "*fp32") | dict.fromkeys(SIZES, "i32")
    signature |= dict.fromkeys(SCALES, "fp32")
    constants = {"BLOCK": BLOCK} | dict.fromkeys(left_out)
    variant = "plain" if left_out else "weighted"
    return KernelSpec(variation_kernel, signature, constants, NUM_WARPS, variant=variant)


KERNELS = (_spec(WEIGHTS), _spec(()))
