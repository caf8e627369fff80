from __future__ import annotations

from functools import partial

import numba
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.kernels import ssim as losses
from mrgs.kernels.ssim.cpu import compare
from mrgs.method.losses.ssim import ssim_map, structural_similarity

l1_dssim = partial(losses.l1_dssim, compare)


def image(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def as_planes(x: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    return torch.where(weights[:, :, None] > 0, x, 0).permute(2, 0, 1)


def plain_l1_dssim(
    x: torch.Tensor, y: torch.Tensor, weights: torch.Tensor, dssim: float, width: float
) -> torch.Tensor:
    x, y = as_planes(x, weights), as_planes(y, weights)
    if width == 0:
        compared = (x - y).abs()
    else:
        compared = torch.nn.functional.huber_loss(x, y, reduction="none", delta=width) / width
    return (weights * ((1 - dssim) * compared + dssim * (1 - ssim_map(x, y)))).sum()


def holed_weights(
    height: int, width: int, seed: int = 2, dtype: torch.dtype = torch.float32
) -> torch.Tensor:
    weights = image(height, width, seed=seed, dtype=dtype)
    return torch.where(weights > 0.2, weights, 0)


CASES = {
    "height": st.one_of(st.integers(1, 25), st.sampled_from([60, 61, 125])),
    "width": st.one_of(st.integers(1, 25), st.sampled_from([171, 520])),
    "channels": st.integers(1, 4),
    "dssim": st.sampled_from([0.0, 0.2, 1.0]),
    "huber_width": st.sampled_from([0.0, 0.1, 0.5, 3.0]),
    "seed": st.integers(0, 100),
}


def compare_with_plain_torch(
    dtype: torch.dtype, error: float, height, width, channels, dssim, huber_width, seed
) -> None:
    """Total and gradients against float64, as shares of the sum of weights and of their norms."""
    x, y = (image(height, width, channels, seed=seed + k, dtype=dtype) for k in (0, 1))
    weights = holed_weights(height, width, seed, dtype)
    exact_x, exact_y = (each.double().requires_grad_() for each in (x, y))
    expected = plain_l1_dssim(exact_x, exact_y, weights.double(), dssim, huber_width)
    exact = torch.autograd.grad(expected, (exact_x, exact_y))
    result = l1_dssim(x.requires_grad_(), y.requires_grad_(), weights, dssim, huber_width)
    assert abs(result.total - expected.item()) <= error * weights.sum()
    for grad, expected_grad in zip((result.grad_x, result.grad_y), exact, strict=True):
        assert grad is not None
        assert (grad - expected_grad).norm() <= error * expected_grad.norm()


@settings(max_examples=25)
@given(**CASES)
def test_l1_dssim_is_that_of_plain_torch(**case):
    compare_with_plain_torch(torch.float32, 1e-5, **case)


@pytest.mark.slow
@settings(max_examples=25)
@given(**CASES)
def test_l1_dssim_in_float64_is_that_of_plain_torch(**case):
    compare_with_plain_torch(torch.float64, 1e-9, **case)


def test_structural_dissimilarity_is_that_of_plain_torch():
    x, y = (image(70, 40, 1, seed=seed).requires_grad_() for seed in (0, 1))
    weights = holed_weights(70, 40)
    errors = 1 - structural_similarity(as_planes(x, weights), as_planes(y, weights))
    grad_x, grad_y = torch.autograd.grad((weights * errors).sum(), (x, y))
    result = compare(x, y, weights, losses.STRUCTURE, True)
    assert result.total == pytest.approx((weights * errors).sum().item())
    torch.testing.assert_close(result.errors, errors.detach().permute(1, 2, 0))
    torch.testing.assert_close(result.grad_x, grad_x)
    torch.testing.assert_close(result.grad_y, grad_y)


def test_one_row_of_weights_stands_for_all():
    x, y, row = image(65, 12, 2).requires_grad_(), image(65, 12, 2, seed=1), holed_weights(1, 12)
    result, expected = (
        l1_dssim(x, y, weights, 0.2) for weights in (row, row.expand(65, 12).contiguous())
    )
    assert result.total == expected.total
    assert torch.equal(result.grad_x, expected.grad_x)


def test_gradients_are_made_for_what_asks_for_them():
    x, y, weights = image(12, 12, 1), image(12, 12, 1, seed=1), holed_weights(12, 12)
    assert l1_dssim(x, y, weights, 0.2)[1:3] == (None, None)
    assert l1_dssim(x.requires_grad_(), y, weights, 0.2).grad_y is None


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread")
def test_the_number_of_threads_changes_no_bit():
    x, y = (
        image(200, 90, 3, dtype=torch.float32).requires_grad_(),
        image(200, 90, 3, seed=1, dtype=torch.float32),
    )
    weights = holed_weights(200, 90, dtype=torch.float32)
    results = []
    for threads in (1, 2):
        before = numba.get_num_threads()
        numba.set_num_threads(threads)
        results.append(l1_dssim(x, y, weights, 0.2))
        numba.set_num_threads(before)
    assert results[0].total == results[1].total
    assert torch.equal(results[0].grad_x, results[1].grad_x)
