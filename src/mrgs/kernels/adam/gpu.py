"""Adam's step on a GPU: of one tensor by a kernel of our own, of several by torch's, whose fused
step gives 65,536 values to each multiprocessor and leaves most idle for a few hundred thousand."""

from __future__ import annotations

import math

import triton
import triton.language as tl
from torch import Tensor

from mrgs.kernels import adam
from mrgs.kernels.gpu_spec import specialised
from mrgs.kernels.require import require
from mrgs.method.adam import BETA1, BETA2

BLOCK = 1024
"""Values per program."""

MOST_VALUES = 2**31 - BLOCK
"""The kernel numbers them with 32 bits."""

NUM_WARPS = 4
TENSORS = ("parameter", "gradient", "mean", "square", "count", "skip")

KEPT1, KEPT2 = tl.constexpr(BETA1), tl.constexpr(BETA2)
LOG2_KEPT1, LOG2_KEPT2 = tl.constexpr(math.log2(BETA1)), tl.constexpr(math.log2(BETA2))


@triton.jit(do_not_specialize=["size"])
def adam_kernel(
    parameter, gradient, mean, square, count, skip, size, rate, epsilon, BLOCK: tl.constexpr
):
    """Move a parameter and its moments; nothing where ``skip`` is not 0.

    Args:
        parameter, gradient, mean, square: of the same size; all but the gradient are changed.
        count: of steps, this one included; one value.
        size: number of values.
        epsilon: added to the root of the mean square.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < tl.where(tl.load(skip) == 0.0, size, 0)
    steps = tl.load(count)
    g = tl.load(gradient + at, mask=mask, other=0.0)
    m = tl.load(mean + at, mask=mask, other=0.0)
    v = tl.load(square + at, mask=mask, other=0.0)
    m += (g - m) * (1.0 - KEPT1)
    v = v * KEPT2 + g * g * (1.0 - KEPT2)
    size1, size2 = 1.0 - tl.exp2(steps * LOG2_KEPT1), 1.0 - tl.exp2(steps * LOG2_KEPT2)
    change = rate / size1 * m / (tl.sqrt(v / size2) + epsilon)
    tl.store(parameter + at, tl.load(parameter + at, mask=mask, other=0.0) - change, mask=mask)
    tl.store(mean + at, m, mask=mask)
    tl.store(square + at, v, mask=mask)


def move(
    parameters: list[Tensor],
    gradients: list[Tensor],
    means: list[Tensor],
    squares: list[Tensor],
    counts: list[Tensor],
    rate: float,
    epsilon: float,
    skip: Tensor | None,
) -> None:
    """``mrgs.method.adam.move`` for float32 on a GPU; ValueError for other sizes or devices."""
    states = means[0], squares[0], counts[0]
    if (
        len(parameters) != 1
        or skip is None
        or parameters[0].numel() > MOST_VALUES
        or not all(tensor.is_contiguous() for tensor in (parameters[0], *states))
    ):
        adam.move(parameters, gradients, means, squares, counts, rate, epsilon, skip)
        return
    (parameter,), (gradient,) = parameters, gradients
    size = parameter.numel()
    given = (parameter, gradient.contiguous(), *states, skip)
    for name, tensor in zip(TENSORS, given, strict=True):
        shape = () if tensor.dim() == 0 else parameter.shape
        require(name, tensor, shape, device=parameter.device)
    arguments = dict(zip(TENSORS, given, strict=True))
    numbers = {"size": size, "rate": rate, "epsilon": epsilon}
    _SPEC.launch((triton.cdiv(size, BLOCK),), {**arguments, **numbers})


_TYPES = {"size": "i32", "rate": "fp32", "epsilon": "fp32"}
_SPEC = specialised(adam_kernel, {"BLOCK": BLOCK}, _TYPES, NUM_WARPS)

KERNELS = (_SPEC,)
