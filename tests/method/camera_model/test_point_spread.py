from __future__ import annotations

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter

from mrgs.method.camera_model.point_spread import blur


def plane(
    height: int, width: int, seed: int = 0, dtype: torch.dtype = torch.float64
) -> torch.Tensor:
    return torch.rand(
        height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    ).to(dtype)


def sigma(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


@pytest.mark.parametrize("sigma_px", [0.6, 1.2, 2.5])
def test_far_from_the_frame_it_is_a_gaussian_filter(sigma_px):
    image = plane(50, 60)
    expected = gaussian_filter(image.numpy(), sigma_px, truncate=10.0)
    margin = math.ceil(6 * sigma_px)
    inner = (slice(margin, -margin), slice(margin, -margin))
    assert blur(image, sigma(sigma_px)).numpy()[inner] == pytest.approx(expected[inner], abs=1e-3)


@pytest.mark.parametrize("shape", [(9, 12), (1, 1), (3, 40)])
def test_a_constant_stays_constant_up_to_the_frame(shape):
    constant = torch.full(shape, 0.3)
    torch.testing.assert_close(blur(constant, torch.tensor(1.5)), constant)


@pytest.mark.parametrize("shape", [(7, 9), (2, 30), (1, 4)])
@pytest.mark.parametrize("sigma_px", [0.3, 1.1])
def test_it_is_that_of_plain_torch(shape, sigma_px):
    image, width = plane(*shape).requires_grad_(), sigma(sigma_px).requires_grad_()
    results = [f(image, width) for f in (blur, blur.plain)]
    torch.testing.assert_close(*results)
    weights = plane(*shape, seed=1)
    gradients = [
        torch.autograd.grad((weights * result).sum(), (image, width)) for result in results
    ]
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected)


def test_its_gradients():
    image, width = plane(5, 6).requires_grad_(), sigma(0.9).requires_grad_()
    assert torch.autograd.gradcheck(blur, (image, width))
