from __future__ import annotations

import pytest
import torch

from mrgs.kernels.convolution import convolve


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (40, 35)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_is_a_convolution_with_zeros_beyond_the_border(shape, dtype):
    plane, weights, bias = (
        random(*shape, dtype=dtype),
        random(3, 3, seed=1, dtype=dtype),
        random(1, seed=2, dtype=dtype),
    )
    expected = torch.nn.functional.conv2d(plane[None, None], weights[None, None], bias, padding=1)[
        0, 0
    ]
    torch.testing.assert_close(convolve(plane, weights, bias), expected)


def test_gradients():
    inputs = (
        random(6, 7).requires_grad_(),
        random(3, 3, seed=1).requires_grad_(),
        random(1, seed=2).requires_grad_(),
    )
    assert torch.autograd.gradcheck(convolve, inputs)
