"""Adam's Triton kernel against torch's fused step."""

from __future__ import annotations

import pytest
import torch

from mrgs.method.adam import Adam, ParameterGroup, move
from mrgs.system.operation import checking
from mrgs.training.kernel_check import _check_optimizer

pytestmark = pytest.mark.compares_kernels

SHAPES = ((40, 3), (1300, 2), (7, 15, 3), (0, 24))


def steps_of(
    device: str, good: list[bool], shapes=SHAPES, rate: float = 0.02
) -> list[torch.Tensor]:
    """Parameters and moments after some steps, each tensor in a group of its own."""
    generator = torch.Generator().manual_seed(0)
    parameters = [torch.randn(shape, generator=generator).to(device) for shape in shapes]
    adam = Adam([ParameterGroup([each.requires_grad_()], 0.02) for each in parameters], 1e-15)
    for counts in good:
        for each in parameters:
            each.grad = torch.randn(each.shape, generator=generator).to(device)
        adam.step(torch.tensor(counts, device=device))
    return [*parameters, *adam.moments(dict(enumerate(parameters))).values()]


@pytest.mark.parametrize("good", [[True], [True, True, True], [True, False, True], [False]])
def test_steps_are_those_of_torch(gpu_device, good):
    found, expected = steps_of(gpu_device, good), steps_of("cpu", good)
    assert len(found) == len(expected) == 4 * len(SHAPES)
    for value, truth in zip(found, expected, strict=True):
        torch.testing.assert_close(value.cpu(), truth, rtol=1e-4, atol=1e-6)


def test_steps_are_those_of_torch_after_many(gpu_device):
    good = [True] * 300
    for value, truth in zip(
        steps_of(gpu_device, good, SHAPES[:1]), steps_of("cpu", good, SHAPES[:1]), strict=True
    ):
        torch.testing.assert_close(value.cpu(), truth, rtol=1e-3, atol=1e-5)


def test_the_kernel_takes_one_tensor_and_torch_several(gpu_device):
    from mrgs.kernels.adam import gpu

    tensor = torch.ones(3, device=gpu_device)
    count, skip = torch.ones((), device=gpu_device), torch.zeros((), device=gpu_device)
    one = [[tensor.clone()] for _ in range(4)]
    two = [[tensor.clone(), tensor.clone()] for _ in range(4)]
    gpu.move(*one, [count], 0.1, 1e-8, skip)
    gpu.move(*two, [count] * 2, 0.1, 1e-8, None)
    for (alone,), together in zip(one, two, strict=True):
        for each in together:
            torch.testing.assert_close(each, alone)
    with pytest.raises(ValueError, match="square"):
        gpu.move(*one[:3], [tensor[:2]], [count], 0.1, 1e-8, skip)


def test_the_check_compares_the_optimizer_with_the_equation(gpu_device, monkeypatch):
    monkeypatch.setattr(move, "rejected", set())
    with checking():
        _check_optimizer(torch.device(gpu_device), torch.Generator().manual_seed(0))
    assert not move.rejected


def test_what_has_no_gradient_stays(gpu_device):
    tensor = torch.ones(3, device=gpu_device, requires_grad=True)
    Adam([ParameterGroup([tensor], 1.0)]).step()
    assert tensor.tolist() == [1, 1, 1]
    assert move.kernel(([tensor],)) is not None
