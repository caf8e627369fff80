"""The dispatcher of operations, with operations and kernels made for these tests."""

from __future__ import annotations

import importlib
import warnings
from pathlib import Path

import pytest
import torch

from mrgs import kernels
from mrgs.errors import MrgsWarning
from mrgs.system import operation as module
from mrgs.system.gpu import interpreted
from mrgs.system.operation import Operation, checking, disable_kernels, operation

pytestmark = pytest.mark.compares_kernels

SOURCE = Path(kernels.__file__).parents[1]


class WithKernels(Operation):
    """An operation, and its kernels for float32 by their devices."""

    def __init__(self, plain, **kernels) -> None:
        super().__init__(plain)
        self.kernels = kernels

    def listed(self, device, dtype):
        return self.kernels.get(device) if dtype == torch.float32 else None


def make_operation(kernel, **others) -> Operation:
    """x ↦ Σ x² w of a layer, and a kernel for the CPU."""

    def energy(x: torch.Tensor, layer: torch.nn.Linear) -> torch.Tensor:
        return layer(x.square()).sum()

    return WithKernels(energy, cpu=kernel, **others)


def by_a_product(x, layer):
    return ((x * x) @ layer.weight.T + layer.bias).sum()


def with_half_of_a_gradient(x, layer):
    half = 0.5 * (x + x.detach())
    return (half.square() @ layer.weight.T + layer.bias).sum()


def fails(x, layer):
    raise KeyError("layer")


def inputs(dtype=torch.float32):
    torch.manual_seed(0)
    layer = torch.nn.Linear(4, 2).to(dtype)
    return torch.randn(5, 4, dtype=dtype).requires_grad_(), layer


def test_a_kernel_runs_in_place_of_the_plain_definition():
    energy = make_operation(lambda x, layer: "kernel")
    assert energy(*inputs()) == energy(inputs()[0], layer=inputs()[1]) == "kernel"
    assert energy.plain(*inputs()).shape == ()


def test_other_types_and_declined_arguments_are_computed_plainly():
    energy = make_operation(lambda x, layer: "kernel")
    assert energy(*inputs(torch.float64)).dtype == torch.float64
    declining = make_operation(lambda x, layer: NotImplemented)
    assert torch.equal(declining(*inputs()), declining.plain(*inputs()))


def test_kernels_can_be_turned_off(monkeypatch):
    energy = make_operation(lambda x, layer: "kernel")
    with disable_kernels():
        assert energy(*inputs()) != "kernel"
    with disable_kernels(False):
        assert energy(*inputs()) == "kernel"
    with disable_kernels():
        with disable_kernels():
            pass
        assert energy(*inputs()) != "kernel"
    monkeypatch.setenv("MRGS_PLAIN", "1")
    assert energy(*inputs()) != "kernel"
    monkeypatch.setenv("MRGS_PLAIN", "0")
    assert energy(*inputs()) == "kernel"


def test_an_operation_can_be_a_method():
    class Ball:
        radius = 2.0

        @operation
        def area(self, factor: float) -> float:
            """4 π r²."""
            return factor * self.radius**2

    assert Ball().area(3.0) == Ball.area.plain(Ball(), 3.0) == 12.0
    assert Ball.area.__doc__ == "4 π r²."


def test_a_kernel_that_is_right_passes_the_check():
    energy = make_operation(by_a_product)
    x, layer = inputs()
    state = torch.random.get_rng_state()
    with checking():
        energy(x, layer)
    assert not energy.rejected
    assert torch.equal(torch.random.get_rng_state(), state)
    assert x.grad is None
    assert layer.weight.grad is None


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        (lambda x, layer: 1.1 * by_a_product(x, layer), r"error 0\.1"),
        (lambda x, layer: by_a_product(x, layer) * torch.nan, "differs"),
        (with_half_of_a_gradient, r"error 0\.5"),
        (lambda x, layer: by_a_product(x, layer).detach(), "differs"),
        (lambda x, layer: by_a_product(x, layer)[None], "error inf"),
        (fails, "KeyError"),
    ],
)
def test_a_kernel_that_differs_is_not_used_and_one_line_says_so(kernel, message):
    energy = make_operation(kernel)
    with pytest.warns(MrgsWarning, match=f"^energy: .*{message}") as caught, checking():
        results = [energy(*inputs()) for _ in range(2)]
    assert len(caught) == 1
    expected = energy.plain(*inputs())
    assert all(torch.equal(result, expected) for result in (*results, energy(*inputs())))


def test_a_later_check_gives_a_kernel_another_chance():
    def repaired(x, layer):
        return by_a_product(x, layer) if is_repaired else fails(x, layer)

    is_repaired = False
    energy = make_operation(repaired)
    with pytest.warns(MrgsWarning), checking():
        energy(*inputs())
    assert energy.rejected == {repaired}
    is_repaired = True
    with checking():
        energy(*inputs())
    assert not energy.rejected


def test_a_kernel_that_differs_once_is_not_used_because_it_passes_elsewhere():
    def right_for_five(x, layer):
        return by_a_product(x, layer) if len(x) == 5 else 1.1 * by_a_product(x, layer)

    energy = make_operation(right_for_five)
    x, layer = inputs()
    with pytest.warns(MrgsWarning), checking():
        [energy(each, layer) for each in (x[:3], x)]
    assert energy.rejected == {right_for_five}


def test_a_check_without_gradients_leaves_out_what_was_rejected():
    called = []

    def without_gradient(x, layer):
        called.append(x)
        return by_a_product(x, layer).detach()

    energy = make_operation(without_gradient)
    with pytest.warns(MrgsWarning), checking():
        energy(*inputs())
    called.clear()
    with checking(gradients=False):
        energy(*inputs())
    assert energy.rejected == {without_gradient}
    assert not called


@pytest.mark.parametrize(("share", "passes"), [(1e-7, True), (0.5, False)])
def test_a_gradient_that_vanishes_beside_the_others_may_be_rounding_noise(share, passes):
    made = WithKernels(
        lambda a, b: a.sum() + share * b.sum(),
        cpu=lambda a, b: a.sum() + 1.5 * share * b.sum(),
    )
    a, b = torch.ones(4, requires_grad=True), torch.full((4,), 1e-6, requires_grad=True)
    with warnings.catch_warnings(), checking():
        warnings.simplefilter("ignore")
        made(a, b)
    assert (not made.rejected) == passes


def test_a_kernel_may_take_the_other_side_of_a_kink():
    made = WithKernels(
        lambda a, b: (a.clamp(max=1) * b).sum(),
        cpu=lambda a, b: (torch.where(a < 1, a, 1) * b).sum(),
    )
    a, b = (torch.ones(4, requires_grad=True) for _ in range(2))
    with checking():
        made(a, b)
    assert not made.rejected


def test_an_argument_that_changes_nothing_has_no_gradient():
    made = WithKernels(lambda a, b: a.square().sum(), cpu=lambda a, b: (a * a).sum())
    a, b = (torch.ones(4, requires_grad=True) for _ in range(2))
    with checking():
        made(a, b)
    assert not made.rejected


def test_the_kernel_of_another_device_is_judged_apart(monkeypatch):
    energy = make_operation(fails, gpu=lambda x, layer: "kernel")
    with pytest.warns(MrgsWarning), checking():
        energy(*inputs())
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    with interpreted():
        assert energy(*inputs()) == "kernel"
    assert energy.rejected == {fails}


@pytest.mark.parametrize("entry", kernels.TABLE, ids=lambda kernel: kernel.function)
def test_every_kernel_replaces_an_operation(entry):
    if entry.device == "gpu":
        pytest.importorskip("triton")
    parts = entry.replaces.split(".")
    name = next(n for n in range(len(parts), 0, -1) if _is_module(parts[:n]))
    found = importlib.import_module(".".join(parts[:name]))
    operations = [value for value in vars(found).values() if isinstance(value, Operation)]
    operations += [
        value
        for owner in vars(found).values()
        if isinstance(owner, type)
        for value in vars(owner).values()
        if isinstance(value, Operation)
    ]
    if found.__name__ == "mrgs.rasterizer.reference":  # its operations stand in the package
        from mrgs.rasterizer import median_depth, rasterize

        operations = [median_depth, rasterize]
    assert entry.replaces in [value.name for value in operations]
    assert callable(module._imported(entry.function))


def _is_module(parts: list[str]) -> bool:
    path = SOURCE.parent.joinpath(*parts)
    return path.is_dir() or path.with_suffix(".py").exists()
