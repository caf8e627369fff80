"""The workloads whose times on the C++ prototype's machine are known, run here in turns with the
fused pass.

They are written as they were there: what matters is that both machines do the same work, not that
it is done well. ``benchmarks/prototype.py`` holds the known times and says what follows from these.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from benchmarks.plan import Case
from benchmarks.prototype import ADAM, FUSED, MLP, SSIM_CONV, SSIM_SHIFTED
from benchmarks.stages.rasterizer import FusedPass
from benchmarks.timing import Stages, Timing

MLP_ROWS = 50_000
SSIM_WEIGHTS = torch.exp(-0.5 * (torch.arange(-5.0, 6.0) / 1.5) ** 2)
SSIM_WEIGHTS /= SSIM_WEIGHTS.sum()


def stages(case: Case) -> Stages:
    """The fused pass, and the torch parts of a step as the prototype had them."""
    count, width, height = case.size
    fused = FusedPass(count, width, height)
    mlp = nn.Sequential(
        nn.Linear(32, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 1)
    )
    inputs = torch.randn(MLP_ROWS, 32, requires_grad=True)
    x = torch.rand(4, height, width, requires_grad=True)
    y = torch.rand(4, height, width)
    optimizer = _adam(MLP_ROWS)
    return Stages(
        [
            Timing(FUSED, lambda _: fused.forward_backward()),
            Timing(
                MLP, lambda _: torch.autograd.grad(mlp(inputs).sum(), [inputs, *mlp.parameters()])
            ),
            Timing(SSIM_CONV, lambda _: torch.autograd.grad(_ssim(x, y, window_by_convolution), x)),
            Timing(SSIM_SHIFTED, lambda _: torch.autograd.grad(_ssim(x, y, window_by_shifts), x)),
            Timing(ADAM, lambda _: optimizer.step()),
        ]
    )


def _adam(rows: int) -> torch.optim.Adam:
    """Over the 59 parameters of a plain Gaussian, and a second opacity."""
    parameters = [torch.randn(rows, width, requires_grad=True) for width in (3, 4, 3, 2, 48)]
    for parameter in parameters:
        parameter.grad = torch.ones_like(parameter)
    return torch.optim.Adam(parameters, fused=True)


def window_by_convolution(planes: Tensor) -> Tensor:
    """The 11 × 11 window as one convolution per plane."""
    kernel = torch.outer(SSIM_WEIGHTS, SSIM_WEIGHTS).expand(len(planes), 1, 11, 11)
    return nn.functional.conv2d(planes[None], kernel, padding=5, groups=len(planes))[0]


def window_by_shifts(planes: Tensor) -> Tensor:
    """The same as a sum of shifted images, along the columns and then along the rows."""
    for axis, padding in ((1, (0, 0, 5, 5)), (2, (5, 5))):
        size, padded = planes.shape[axis], nn.functional.pad(planes, padding)
        planes = sum(
            (
                weight * padded.narrow(axis, k, size)
                for k, weight in enumerate(SSIM_WEIGHTS.tolist())
            ),
            torch.zeros(()),
        )
    return planes


def _ssim(x: Tensor, y: Tensor, window: Callable[[Tensor], Tensor]) -> Tensor:
    """Mean SSIM from five windowed moments."""
    mean_x, mean_y = window(x), window(y)
    variance_x, variance_y = window(x * x) - mean_x**2, window(y * y) - mean_y**2
    covariance = window(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
    return (luminance * (2 * covariance + 9e-4) / (variance_x + variance_y + 9e-4)).mean()
