from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.field.encoding import positional_encoding
from mrgs.kernels.dense import encode, encode_backward


@pytest.mark.parametrize("frequencies", [0, 1, 4, 10])
def test_encoding_is_the_plain_one(frequencies):
    points = np.random.default_rng(0).uniform(-3, 3, (32, 3)).astype(np.float32)
    points[:3] = [[0, 0.5, -0.5], [1, -1, 2], [0.25, 1.5, 1000.3]]
    encoded = np.empty((32, 6 * frequencies), np.float32)
    encode(points, frequencies, encoded)
    expected = positional_encoding(torch.from_numpy(points).double(), frequencies)
    np.testing.assert_allclose(encoded, expected.numpy(), atol=5e-7)


def test_encoding_keeps_what_is_not_finite():
    encoded = np.empty((1, 6), np.float32)
    encode(np.array([[np.nan, np.inf, 0]], np.float32), 1, encoded)
    np.testing.assert_array_equal(np.isnan(encoded[0]), [True, True, False, True, True, False])


def test_encoding_gradient():
    point = torch.tensor([[0.3, -0.7, 0.9]], dtype=torch.float64, requires_grad=True)
    plain = positional_encoding(point, 4)
    weights = torch.linspace(-1, 2, 24, dtype=torch.float64)
    (expected,) = torch.autograd.grad((plain[0] * weights).sum(), point)
    gradient = np.ones(3, np.float32)
    encode_backward(
        plain.detach().float().numpy(), weights[None].float().numpy(), 0, 0, 4, gradient
    )
    np.testing.assert_allclose(gradient - 1, expected[0], rtol=1e-5)
