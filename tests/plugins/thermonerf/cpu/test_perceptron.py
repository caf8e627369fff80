from __future__ import annotations

import pytest
import torch

from mrgs_thermonerf.networks import perceptron


@pytest.mark.parametrize(
    ("rows", "widths"), [(1, (3, 16, 1)), (33, (20, 16, 1)), (200, (31, 64, 3)), (70, (32, 40, 16))]
)
def test_values_and_gradients_are_those_of_plain_torch(rows, widths):
    inputs, hidden, outputs = widths
    generator = torch.Generator().manual_seed(rows)
    shapes = [(rows, inputs), (hidden, inputs), (hidden,), (outputs, hidden), (outputs,)]
    tensors = [torch.randn(*shape, generator=generator) for shape in shapes]
    upstream = torch.randn(rows, outputs, generator=generator)
    results = []
    for function in (perceptron, lambda x, w, b, v, c: torch.relu(x @ w.T + b) @ v.T + c):
        leaves = [tensor.clone().requires_grad_() for tensor in tensors]
        values = function(*leaves)
        results.append((values, *torch.autograd.grad(values, leaves, upstream)))
    for ours, plain in zip(*results, strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-4, atol=1e-4)
