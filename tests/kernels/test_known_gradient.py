from __future__ import annotations

import pytest
import torch

from mrgs.kernels.known_gradient import with_gradients


def test_the_gradients_are_those_given_times_the_losses_weight():
    x, y = torch.ones(2, 3, requires_grad=True), torch.ones(4, requires_grad=True)
    slope = torch.arange(6.0).view(2, 3)
    loss = with_gradients(5.0, (x, y), (slope, None))
    assert loss.item() == 5
    (3 * loss).backward()
    torch.testing.assert_close(x.grad, 3 * slope)
    assert y.grad is None


def test_nothing_to_differentiate():
    assert not with_gradients(5.0, (torch.ones(2),), (None,)).requires_grad


def test_it_is_differentiable_once():
    x, weight = torch.ones(2, requires_grad=True), torch.tensor(2.0, requires_grad=True)
    (gradient,) = torch.autograd.grad(
        weight * with_gradients(5.0, (x,), (torch.ones(2),)), x, create_graph=True
    )
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()
