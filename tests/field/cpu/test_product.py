from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.kernels.dense import (
    BLOCK_ROWS,
    TILE_COLUMNS,
    TILE_ROWS,
    add_product,
    multiply,
    panels,
    product,
    rounded_up,
)


def random_array(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@pytest.mark.parametrize(("k", "n"), [(1, 1), (24, 16), (84, 128), (7, 130)])
def test_multiply_is_the_product_plus_the_bias(k, n):
    width = rounded_up(n, TILE_COLUMNS)
    rows, right = random_array(BLOCK_ROWS, k + 3), random_array(k, n, seed=1)
    bias, out = np.zeros(width, np.float32), np.full((BLOCK_ROWS, width), np.nan, np.float32)
    bias[:n] = random_array(n, seed=2)
    multiply(rows, panels(right), bias, out)
    expected = rows[:, :k].astype(np.float64) @ right + bias[:n]
    np.testing.assert_allclose(out[:, :n], expected, atol=1e-5)
    assert (out[:, n:] == 0).all()


@pytest.mark.parametrize("n", [16, 48, 128])
def test_each_sum_is_added_up_in_order_whatever_tile_it_is_in(n):
    """Each column of a product has the bits that it has in a product of its own."""
    rows, right = random_array(BLOCK_ROWS, 24), random_array(24, n, seed=1)
    together = np.empty((BLOCK_ROWS, n), np.float32)
    multiply(rows, panels(right), np.zeros(n, np.float32), together)
    alone, no_bias = np.empty((BLOCK_ROWS, TILE_COLUMNS), np.float32), np.zeros(16, np.float32)
    for first in range(0, n, TILE_COLUMNS):
        multiply(rows, panels(right[:, first : first + TILE_COLUMNS]), no_bias, alone)
        np.testing.assert_array_equal(together[:, first : first + TILE_COLUMNS], alone)


@pytest.mark.parametrize(("m", "n"), [(TILE_ROWS, TILE_COLUMNS), (24, 128), (128, 48)])
def test_products_are_added_to_the_sums(m, n):
    a, b, start = (
        random_array(BLOCK_ROWS, m),
        random_array(BLOCK_ROWS, n, seed=1),
        random_array(m, n, seed=2),
    )
    sums = start.copy()
    add_product(a, b, sums)
    np.testing.assert_allclose(sums, start + a.T.astype(np.float64) @ b, atol=1e-5)


@pytest.mark.parametrize(("m", "k", "n"), [(1, 1, 1), (9, 32, 129), (128, 24, 25)])
def test_small_products_and_their_gradients(m, k, n):
    torch.manual_seed(0)
    a, b, weights = torch.randn(m, k), torch.randn(n, k).T, torch.randn(m, n)
    single = [tensor.clone().requires_grad_() for tensor in (a, b)]
    double = [tensor.double().requires_grad_() for tensor in (a, b)]
    result, expected = product(*single), double[0] @ double[1]
    torch.testing.assert_close(result.double(), expected, atol=1e-5, rtol=0)
    grads = torch.autograd.grad((result * weights).sum(), single)
    expected_grads = torch.autograd.grad((expected * weights).sum(), double)
    torch.testing.assert_close(
        [grad.double() for grad in grads], list(expected_grads), atol=1e-4, rtol=0
    )
