from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.method.losses.ssim import (
    WEIGHTS,
    local_statistics,
    ssim_map,
    structural_similarity,
    window_mean,
)


def image(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def naive_window_mean(planes: torch.Tensor) -> torch.Tensor:
    """One two-dimensional convolution with an explicit 11 × 11 kernel."""
    offsets = torch.arange(-5, 6, dtype=planes.dtype)
    kernel = torch.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    return torch.nn.functional.conv2d(
        planes[:, None], (kernel / kernel.sum())[None, None], padding=5
    )[:, 0]


@settings(deadline=None, max_examples=30)
@given(
    channels=st.integers(0, 4),
    height=st.integers(1, 25),
    width=st.integers(1, 25),
    double=st.booleans(),
)
def test_window_mean_is_a_convolution(channels, height, width, double):
    planes = image(channels, height, width, dtype=torch.float64 if double else torch.float32)
    result = window_mean(planes)
    assert result.dtype == planes.dtype
    torch.testing.assert_close(result, naive_window_mean(planes))


def test_window_weights_sum_to_one_and_are_symmetric():
    assert WEIGHTS.sum().item() == pytest.approx(1)
    torch.testing.assert_close(WEIGHTS.flip(0), WEIGHTS, rtol=0, atol=0)


def test_gradients():
    x, y = image(2, 6, 4).requires_grad_(), image(2, 6, 4, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(window_mean, x)
    assert torch.autograd.gradgradcheck(window_mean, x)
    assert torch.autograd.gradcheck(ssim_map, (x, y))
    assert torch.autograd.gradcheck(structural_similarity, (x, y))


def test_ssim_agrees_with_the_naive_formula():
    x, y = image(3, 30, 40), image(3, 30, 40, seed=1)
    mean_x, mean_y = naive_window_mean(x), naive_window_mean(y)
    variance_x = naive_window_mean(x * x) - mean_x**2
    variance_y = naive_window_mean(y * y) - mean_y**2
    covariance = naive_window_mean(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    expected = ((2 * mean_x * mean_y + c1) * (2 * covariance + c2)) / (
        (mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)
    )
    torch.testing.assert_close(ssim_map(x, y), expected)


@pytest.mark.slow
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("data_range", [1.0, None])
def test_ssim_agrees_with_torchmetrics(channels, data_range):
    from torchmetrics.functional.image import structural_similarity_index_measure

    x = 0.8 * image(channels, 41, 53, dtype=torch.float32)
    y = 0.6 * x + 0.1 * image(channels, 41, 53, seed=1, dtype=torch.float32)
    theirs, their_map = structural_similarity_index_measure(
        x[None], y[None], data_range=data_range, return_full_image=True
    )
    our_range = data_range or torch.maximum(x.max() - x.min(), y.max() - y.min())

    interior = (slice(None), slice(5, -5), slice(5, -5))
    torch.testing.assert_close(
        ssim_map(x, y, our_range)[interior], their_map[0][interior], atol=1e-5, rtol=0
    )
    reflected = [
        torch.nn.functional.pad(planes[None], (5, 5, 5, 5), mode="reflect")[0] for planes in (x, y)
    ]
    torch.testing.assert_close(
        ssim_map(*reflected, our_range)[interior].mean(), theirs, atol=1e-5, rtol=0
    )


def test_structural_similarity_is_the_papers_formula():
    x, y = image(1, 30, 40), image(1, 30, 40, seed=1)
    local = local_statistics(x, y)
    expected = (2 * local.covariance + 9e-4) / (local.variance_x + local.variance_y + 9e-4)
    torch.testing.assert_close(structural_similarity(x, y), expected)


def test_structural_similarity_is_blind_to_brightness_and_sees_inversion():
    x = image(1, 30, 40)
    inside = (slice(None), slice(5, -5), slice(5, -5))
    brighter = structural_similarity(x, x + 0.3)[inside]
    torch.testing.assert_close(brighter, torch.ones_like(brighter))
    assert structural_similarity(x, 1 - x)[inside].mean() < -0.9


def test_an_image_is_like_itself():
    x = image(3, 20, 20)
    torch.testing.assert_close(ssim_map(x, x), torch.ones_like(x))


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_flat_images_have_finite_values_and_gradients(level):
    x = torch.full((1, 16, 16), level, requires_grad=True)
    y = torch.full((1, 16, 16), 0.5)
    for similarity in (ssim_map(x, y), structural_similarity(x, y)):
        (gradient,) = torch.autograd.grad(similarity.sum(), x)
        assert similarity.isfinite().all()
        assert gradient.isfinite().all()
