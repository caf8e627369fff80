"""Spherical harmonics of each Gaussian seen from a camera, one thread per Gaussian, which reads the
coefficients once: torch would start some 40 kernels for degree 3, twice as many for gradients."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.field import spherical_harmonics as sh
from mrgs.kernels.gpu_spec import Arguments, KernelSpec, device_function, specialised
from mrgs.kernels.require import require

BLOCK = 128
"""Gaussians per program."""

MOST_VALUES = 2**31 - 2**16
"""Coefficients of a tensor: 32 bits number them, also beyond the last Gaussian's in a program."""

NUM_WARPS = 4
SIZES = ("count", "bands", "held")
TYPES = dict.fromkeys(SIZES, "i32") | {"floor": "fp32"}

VARIANTS = {3: "color", 1: "scalar"}
"""Names of the specialisations, by the number of channels."""

SMALLEST_DISTANCE = tl.constexpr(1e-12)
CONSTANT = tl.constexpr(sh.C0)
FIRST = tl.constexpr(sh.C1)
SECOND = tl.constexpr(sh.C2)
SECOND_ZONAL = tl.constexpr(sh.C2_ZONAL)
THIRD_ORDER1 = tl.constexpr(sh.C3_ORDER1)
THIRD_ORDER2 = tl.constexpr(sh.C3_ORDER2)
THIRD_ORDER3 = tl.constexpr(sh.C3_ORDER3)
THIRD_ZONAL = tl.constexpr(sh.C3_ZONAL)
BANDS = tl.constexpr(sh.MOST_BANDS)


@device_function
def _direction(means, camera, i, mask):
    """The unit vector from the camera to a Gaussian, and 1 / distance."""
    x = tl.load(means + 3 * i, mask=mask, other=0.0) - tl.load(camera)
    y = tl.load(means + 3 * i + 1, mask=mask, other=0.0) - tl.load(camera + 1)
    z = tl.load(means + 3 * i + 2, mask=mask, other=0.0) - tl.load(camera + 2)
    inverse = 1.0 / tl.maximum(tl.sqrt(x * x + y * y + z * z), SMALLEST_DISTANCE)
    return x * inverse, y * inverse, z * inverse, inverse


@device_function
def _basis(x, y, z):
    """The 15 basis functions of degrees 1 to 3, as in ``spherical_harmonics``."""
    xx, yy, zz = x * x, y * y, z * z
    return (
        y * -FIRST, z * FIRST, x * -FIRST,
        x * y * SECOND, y * z * -SECOND, (2 * zz - xx - yy) * SECOND_ZONAL, x * z * -SECOND,
        (xx - yy) * (0.5 * SECOND),
        y * (3 * xx - yy) * -THIRD_ORDER3,
        x * y * z * THIRD_ORDER2,
        y * (4 * zz - xx - yy) * -THIRD_ORDER1,
        z * (2 * zz - 3 * xx - 3 * yy) * THIRD_ZONAL,
        x * (4 * zz - xx - yy) * -THIRD_ORDER1,
        z * (xx - yy) * (0.5 * THIRD_ORDER2),
        x * (xx - 3 * yy) * -THIRD_ORDER3,
    )  # fmt: skip


@device_function
def _basis_slopes(x, y, z):
    """∂/∂(x, y, z) of the basis functions, each by x, y and z."""
    xx, yy, zz = x * x, y * y, z * z
    zero = tl.zeros_like(x)
    return (
        (zero, zero - FIRST, zero),
        (zero, zero, zero + FIRST),
        (zero - FIRST, zero, zero),
        (y * SECOND, x * SECOND, zero),
        (zero, z * -SECOND, y * -SECOND),
        (x * (-2 * SECOND_ZONAL), y * (-2 * SECOND_ZONAL), z * (4 * SECOND_ZONAL)),
        (z * -SECOND, zero, x * -SECOND),
        (x * SECOND, y * -SECOND, zero),
        (x * y * (-6 * THIRD_ORDER3), (xx - yy) * (-3 * THIRD_ORDER3), zero),
        (y * z * THIRD_ORDER2, x * z * THIRD_ORDER2, x * y * THIRD_ORDER2),
        (x * y * (2 * THIRD_ORDER1), (4 * zz - xx - 3 * yy) * -THIRD_ORDER1,
         y * z * (-8 * THIRD_ORDER1)),
        (x * z * (-6 * THIRD_ZONAL), y * z * (-6 * THIRD_ZONAL),
         (6 * zz - 3 * xx - 3 * yy) * THIRD_ZONAL),
        ((4 * zz - 3 * xx - yy) * -THIRD_ORDER1, x * y * (2 * THIRD_ORDER1),
         x * z * (-8 * THIRD_ORDER1)),
        (x * z * THIRD_ORDER2, y * z * -THIRD_ORDER2, (xx - yy) * (0.5 * THIRD_ORDER2)),
        ((xx - yy) * (-3 * THIRD_ORDER3), x * y * (6 * THIRD_ORDER3), zero),
    )  # fmt: skip


@triton.jit(do_not_specialize=SIZES)
def shade_kernel(
    means, camera, dc, rest, values, count, bands, held, floor, CHANNELS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Harmonics of the viewing direction + ½, not below the floor.

    Args:
        means, camera: centres, [N, 3], and centre of projection, [3].
        dc, rest: coefficients of degree 0, [N, 1, C], and of the higher degrees, [N, B, C].
        values: filled, [N, C].
        count, held, CHANNELS: N, B and C.
        bands: coefficients that count.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    x, y, z, _ = _direction(means, camera, i, inside)
    basis = _basis(x, y, z)
    for channel in tl.static_range(CHANNELS):
        value = tl.load(dc + i * CHANNELS + channel, mask=inside, other=0.0) * CONSTANT + 0.5
        for band in tl.static_range(BANDS):
            at = rest + (i * held + band) * CHANNELS + channel
            value += basis[band] * tl.load(at, mask=inside & (band < bands), other=0.0)
        # So that NaN stays.
        tl.store(
            values + i * CHANNELS + channel, tl.where(value < floor, floor, value), mask=inside
        )


@triton.jit(do_not_specialize=SIZES)
def shade_backward_kernel(
    means, camera, dc, rest, values, gradient, grad_means, grad_dc, grad_rest, count, bands, held,
    floor, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The gradients behind ``shade_kernel``, which explains the arguments not named here.

    Args:
        gradient: by the values, [N, C].
        grad_means, grad_dc, grad_rest: filled; 0 for the coefficients that do not count.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    x, y, z, inverse = _direction(means, camera, i, inside)
    basis, slopes = _basis(x, y, z), _basis_slopes(x, y, z)
    along_x, along_y, along_z = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for channel in tl.static_range(CHANNELS):
        at = i * CHANNELS + channel
        is_above = tl.load(values + at, mask=inside, other=0.0) > floor
        g = tl.where(is_above, tl.load(gradient + at, mask=inside, other=0.0), 0.0)
        tl.store(grad_dc + at, g * CONSTANT, mask=inside)
        for band in tl.static_range(BANDS):
            at = (i * held + band) * CHANNELS + channel
            counts = inside & (band < bands)
            weight = g * tl.load(rest + at, mask=counts, other=0.0)
            along_x += weight * slopes[band][0]
            along_y += weight * slopes[band][1]
            along_z += weight * slopes[band][2]
            by_rest = tl.where(counts, basis[band] * g, 0.0)
            tl.store(grad_rest + at, by_rest, mask=inside & (band < held))
    # (I − d dᵀ) g / distance, the gradient of a unit direction d.
    along = x * along_x + y * along_y + z * along_z
    tl.store(grad_means + 3 * i, inverse * (along_x - along * x), mask=inside)
    tl.store(grad_means + 3 * i + 1, inverse * (along_y - along * y), mask=inside)
    tl.store(grad_means + 3 * i + 2, inverse * (along_z - along * z), mask=inside)


def shade(
    means: Float[Tensor, "n 3"],
    dc: Float[Tensor, "n 1 c"],
    rest: Float[Tensor, "n b c"],
    camera_position: Float[Tensor, "3"],
    degree: int,
    rows: Int64[Tensor, " v"] | None = None,
    floor: float = 0.0,
) -> Float[Tensor, "v c"]:
    """``mrgs.field.spherical_harmonics.shade`` for float32 on a GPU and all rows, of 1 or 3
    channels; NotImplemented for others, for degree 0, which torch computes at once, and for more
    coefficients than the kernels can number. ValueError for other sizes, types or devices."""
    count, channels, device = len(means), dc.shape[-1], means.device
    bands = min((degree + 1) ** 2 - 1, rest.shape[1])
    if rows is not None or channels not in VARIANTS or not 0 < bands <= sh.MOST_BANDS:
        return NotImplemented
    if rest.numel() > MOST_VALUES:
        return NotImplemented
    require("means", means, (count, 3), device=device)
    require("dc", dc, (count, 1, channels), device=device)
    require("rest", rest, (count, None, channels), device=device)
    require("camera_position", camera_position, (3,), device=device)
    shaded: Tensor = _Shade.apply(means, dc, rest, camera_position, bands, floor)
    return shaded


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        means, dc, rest, camera, bands, floor = inputs
        tensors = {"means": means, "camera": camera, "dc": dc, "rest": rest}
        tensors = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
        values = means.new_empty(len(means), dc.shape[2])
        ctx.numbers = {
            "count": len(means), "bands": bands, "held": rest.shape[1], "floor": floor
        }  # fmt: skip
        _launch(shade_kernel, tensors | ctx.numbers, values=values)
        ctx.save_for_backward(*tensors.values(), values)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        means, camera, dc, rest, values = ctx.saved_tensors
        grads = [torch.empty_like(each) for each in (means, dc, rest)]
        _launch(
            shade_backward_kernel, ctx.numbers, means=means, camera=camera, dc=dc, rest=rest,
            values=values, gradient=gradient.contiguous(),
            grad_means=grads[0], grad_dc=grads[1], grad_rest=grads[2],
        )  # fmt: skip
        camera_gradient = -grads[0].sum(dim=0) if ctx.needs_input_grad[3] else None
        return (*grads, camera_gradient, None, None)


def _launch(kernel: Any, given: Arguments, **tensors: Tensor) -> None:
    given = given | tensors
    programs = triton.cdiv(given["count"], BLOCK)
    _spec(kernel, given["dc"].shape[2]).launch((programs,), given)


def _spec(kernel: Any, channels: int) -> KernelSpec:
    """A kernel for a number of channels."""
    constants = {"CHANNELS": channels, "BLOCK": BLOCK}
    return specialised(kernel, constants, TYPES, NUM_WARPS, variant=VARIANTS[channels])


KERNELS = tuple(
    _spec(kernel, channels)
    for kernel in (shade_kernel, shade_backward_kernel)
    for channels in VARIANTS
)
