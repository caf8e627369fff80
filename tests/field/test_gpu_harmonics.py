"""The Triton kernel of the spherical harmonics against their plain definition."""

from __future__ import annotations

import math

import pytest
import torch

from mrgs.field.spherical_harmonics import shade

COUNT = 150


def inputs(channels: int, held: int) -> list[torch.Tensor]:
    """Centres, coefficients and camera; some values below any floor."""
    generator = torch.Generator().manual_seed(channels * 100 + held)
    shapes = ((COUNT, 3), (COUNT, 1, channels), (COUNT, held, channels), (3,))
    return [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes]


@pytest.mark.parametrize("floor", [0.0, -math.inf])
@pytest.mark.parametrize(
    ("channels", "held", "degree"),
    [(3, 15, 3), (3, 15, 2), (3, 15, 1), (3, 15, 0), (1, 15, 3), (1, 3, 3), (1, 0, 3), (2, 15, 3)],
)
def test_values_and_gradients(gpu_device, channels, held, degree, floor):
    found, truth = [], []
    for results, device, dtype, function in (
        (found, gpu_device, torch.float32, shade),
        (truth, "cpu", torch.float64, shade.plain),
    ):
        leaves = [each.to(device, dtype).requires_grad_() for each in inputs(channels, held)]
        values = function(*leaves, degree, floor=floor)
        weights = torch.linspace(-1, 1, values.numel(), dtype=torch.float64).view(values.shape)
        loss = (values * weights.to(values)).sum()
        results += [values, *torch.autograd.grad(loss, leaves, materialize_grads=True)]
    for value, expected in zip(found, truth, strict=True):
        torch.testing.assert_close(
            value.detach().cpu().double(), expected.detach(), rtol=1e-4, atol=1e-4
        )


def test_more_coefficients_than_can_be_numbered_are_left_to_torch(gpu_device):
    from mrgs.kernels.harmonics import gpu

    count = gpu.MOST_VALUES // 45 + 1
    shapes = ((count, 3), (count, 1, 3), (count, 15, 3))
    many = [torch.zeros(1, device=gpu_device).expand(shape) for shape in shapes]  # take no memory
    assert gpu.shade(*many, torch.zeros(3, device=gpu_device), 3) is NotImplemented


def test_no_gaussians(gpu_device):
    means = torch.zeros(0, 3, device=gpu_device, requires_grad=True)
    coefficients = [torch.zeros(0, bands, 3, device=gpu_device) for bands in (1, 15)]
    values = shade(means, *coefficients, torch.zeros(3, device=gpu_device), 3)
    assert values.shape == (0, 3)
    values.sum().backward()
    assert means.grad is not None


def test_what_is_not_a_number_stays_so(gpu_device):
    means, dc, rest, camera = (each.float().to(gpu_device) for each in inputs(3, 15))
    means[4] = float("nan")
    values = shade(means, dc, rest, camera, 3)
    assert values[4].isnan().all()
    assert values[:4].isfinite().all()
