"""The step that trains is the equation of Adam."""

from __future__ import annotations

import pytest
import torch

from mrgs.errors import KernelWarning
from mrgs.method.adam import Adam, ParameterGroup, move
from mrgs.system.gpu import HOST
from mrgs.system.operation import checking, disable_kernels
from mrgs.training.kernel_check import _check_optimizer

pytestmark = pytest.mark.compares_kernels


@pytest.fixture(autouse=True)
def none_is_rejected(monkeypatch):
    monkeypatch.setattr(move, "rejected", set())


def after_steps(good: list[bool]) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    tensors = [
        torch.randn(shape, generator=generator).requires_grad_() for shape in ((40, 3), (7,))
    ]
    adam = Adam([ParameterGroup(tensors, 0.02)])
    for counts in good:
        for each in tensors:
            each.grad = torch.randn(each.shape, generator=generator)
        adam.step(torch.tensor(counts))
    return [*tensors, *adam.moments(dict(enumerate(tensors))).values()]


@pytest.mark.parametrize("good", [[True] * 3, [True, False, True], [False]])
def test_the_equation_moves_as_torch_does(good):
    with disable_kernels():
        expected = after_steps(good)
    for found, each in zip(after_steps(good), expected, strict=True):
        torch.testing.assert_close(found, each)


def test_the_check_accepts_the_kernel():
    with checking():
        _check_optimizer(HOST, torch.Generator())
    assert not move.rejected


def test_an_edited_equation_runs(monkeypatch):
    def descend(parameters, gradients, means, squares, counts, rate, *others):
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter -= rate * gradient

    monkeypatch.setattr(move, "plain", descend)
    with pytest.warns(KernelWarning), checking():
        _check_optimizer(HOST, torch.Generator())
    assert move.rejected
    parameter = torch.ones(2).requires_grad_()
    parameter.grad = torch.tensor([1.0, 2.0])
    Adam([ParameterGroup([parameter], 0.1)]).step()
    torch.testing.assert_close(parameter.detach(), torch.tensor([0.9, 0.8]))
