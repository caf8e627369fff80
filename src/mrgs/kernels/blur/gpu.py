"""A Gaussian blur whose width is learned, along one axis at a time, and its gradients by the image
and by the width.

Along an axis, each place receives the mean P x of its neighbourhood inside the frame, with the
weights w_k = exp(−k²/2σ²) over their sum t. Its derivative by σ is (w' ∗ x − (P x) (w' ∗ 1)) / t
with w' = ∂w/∂σ = w k²/σ³, and its adjoint w ∗ (g / t), for w is symmetric. How far the weights
reach depends on σ, which the kernels read on the device. Sums are taken in a fixed order: the same
bits on every run.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels.gpu_spec import Arguments, KernelSpec, specialised
from mrgs.kernels.require import require
from mrgs.method.camera_model.point_spread import REACH

BLOCK = 256
"""Pixels per program."""

NUM_WARPS = 4
SIZES = ("height", "width")
TYPES = dict.fromkeys(SIZES, "i32") | {"reach": "fp32"}


@triton.jit(do_not_specialize=SIZES)
def blur_kernel(
    plane, sigma, result, weight_sums, height, width, reach, AXIS: tl.constexpr, BLOCK: tl.constexpr
):
    """P x along an axis.

    Args:
        plane: x, [H, W].
        sigma: σ in pixels, one value.
        result: receives P x.
        weight_sums: receives t by the place along the axis, [H] or [W].
        reach: how many σ away the weights end.
        AXIS: 0 down the columns, 1 along the rows.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < height * width
    row, column = at // width, at % width
    place, across, size, pitch = (
        (row, column, height, width) if AXIS == 0 else (column, row, width, 1)
    )
    width_px = tl.load(sigma)
    radius = tl.minimum(tl.ceil(reach * width_px).to(tl.int32), size)
    total, weight_sum = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for k in range(-radius, radius + 1):
        weight = tl.exp(-0.5 * k * k / (width_px * width_px))
        inside = mask & (place + k >= 0) & (place + k < size)
        total += weight * tl.load(plane + at + k * pitch, mask=inside, other=0.0)
        weight_sum += tl.where(inside, weight, 0.0)
    tl.store(result + at, total / tl.where(mask, weight_sum, 1.0), mask=mask)
    tl.store(weight_sums + place, weight_sum, mask=mask & (across == 0))


@triton.jit(do_not_specialize=SIZES)
def blur_backward_kernel(
    plane, sigma, gradient, weight_sums, result, by_sigma, height, width, reach,
    AXIS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The gradients behind ``blur_kernel``, which explains the arguments not named here.

    Args:
        gradient: by P x, [H, W].
        weight_sums: t, as the forward kernel stored it.
        result: receives the gradient by x.
        by_sigma: receives each program's part of the gradient by σ.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < height * width
    row, column = at // width, at % width
    place, size, pitch = (row, height, width) if AXIS == 0 else (column, width, 1)
    width_px = tl.load(sigma)
    radius = tl.minimum(tl.ceil(reach * width_px).to(tl.int32), size)
    centre = tl.load(plane + at, mask=mask, other=0.0)
    total, slope = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    slope_sum, adjoint = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for k in range(-radius, radius + 1):
        squared = k * k / (width_px * width_px)
        weight = tl.exp(-0.5 * squared)
        weight_slope = weight * squared / width_px
        inside = mask & (place + k >= 0) & (place + k < size)
        # A constant changes nothing, and without the pixel's own value the sums below keep their
        # digits.
        value = tl.where(
            inside, tl.load(plane + at + k * pitch, mask=inside, other=0.0) - centre, 0.0
        )
        total += weight * value
        slope += weight_slope * value
        slope_sum += tl.where(inside, weight_slope, 0.0)
        arriving = tl.load(gradient + at + k * pitch, mask=inside, other=0.0)
        adjoint += weight * arriving / tl.load(weight_sums + place + k, mask=inside, other=1.0)
    tl.store(result + at, adjoint, mask=mask)
    own = tl.load(gradient + at, mask=mask, other=0.0)
    weight_sum = tl.load(weight_sums + place, mask=mask, other=1.0)
    change = own * (slope - total / weight_sum * slope_sum) / weight_sum
    tl.store(by_sigma + tl.program_id(0), tl.sum(change, axis=0))


def blur(plane: Tensor, sigma_px: Tensor) -> Tensor:
    """``mrgs.method.camera_model.point_spread.blur`` for float32; σ stays on the device. ValueError
    for tensors of other sizes, types or devices."""
    require("plane", plane, (None, None), device=plane.device)
    require("sigma_px", sigma_px, (), device=plane.device)
    result: Tensor = _Blur.apply(plane, sigma_px)
    return result


class _Blur(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, sigma_px: Tensor) -> Tensor:
        plane, sigma_px = plane.contiguous(), sigma_px.detach()
        along, column_sums = _forward(plane, sigma_px, 1)
        blurred, row_sums = _forward(along, sigma_px, 0)
        ctx.save_for_backward(plane, along, sigma_px, column_sums, row_sums)
        return blurred

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        plane, along, sigma_px, column_sums, row_sums = ctx.saved_tensors
        by_along, change_down = _backward(along, sigma_px, gradient.contiguous(), row_sums, 0)
        by_plane, change_along = _backward(plane, sigma_px, by_along, column_sums, 1)
        return by_plane, (change_down + change_along).to(sigma_px.dtype)


def _forward(plane: Tensor, sigma_px: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    result, weight_sums = torch.empty_like(plane), plane.new_empty(plane.shape[axis])
    _launch(blur_kernel, axis, plane, sigma=sigma_px, result=result, weight_sums=weight_sums)
    return result, weight_sums


def _backward(
    plane: Tensor, sigma_px: Tensor, gradient: Tensor, weight_sums: Tensor, axis: int
) -> tuple[Tensor, Tensor]:
    """The gradients by the plane and by σ of the blur along one axis."""
    result = torch.empty_like(plane)
    by_sigma = plane.new_empty(triton.cdiv(plane.numel(), BLOCK))
    _launch(
        blur_backward_kernel, axis, plane, sigma=sigma_px, gradient=gradient,
        weight_sums=weight_sums, result=result, by_sigma=by_sigma,
    )  # fmt: skip
    return result, by_sigma.sum(dtype=torch.float64)


def _launch(kernel: Any, axis: int, plane: Tensor, **others: Tensor) -> None:
    """Start a kernel along an axis of the plane, with its other tensors by name."""
    sizes = dict(zip(SIZES, plane.shape, strict=True))
    given: Arguments = {"plane": plane, **others, **sizes, "reach": REACH}
    _spec(kernel, axis).launch((triton.cdiv(plane.numel(), BLOCK),), given)


def _spec(kernel: Any, axis: int) -> KernelSpec:
    """One of the kernels along an axis."""
    constants = {"AXIS": axis, "BLOCK": BLOCK}
    return specialised(kernel, constants, TYPES, NUM_WARPS, variant=f"axis {axis}")


KERNELS = tuple(
    _spec(kernel, axis) for kernel in (blur_kernel, blur_backward_kernel) for axis in (0, 1)
)
