"""The kernels against the plain torch code, which runs in float64."""

from __future__ import annotations

import copy
import dataclasses

import numba
import pytest
import torch

from mrgs.field import FieldConfig, RadianceField, nearest_neighbours
from mrgs.kernels.dense import SHARES, slots
from mrgs.kernels.harmonics.cpu import shade
from mrgs.scene import RGB, THERMAL, Gaussians

CAMERA = torch.tensor([0.3, -0.2, -4.0])


def make_case(
    count: int = 150, bands: int = 15, **options
) -> tuple[RadianceField, Gaussians, torch.Tensor | None]:
    """A field and Gaussians in float32, with neighbours."""
    torch.manual_seed(0)
    field = RadianceField(FieldConfig(color_scale=0.5, temperature_scale=0.5, **options))
    means = torch.randn(count, 3)
    field.scale.fill_(2.0)  # an exact division: PE_p's top frequency makes 1e-4 of one rounded bit
    k = field.config.neighbours_k
    gaussians = Gaussians(
        means=means, quats=torch.randn(count, 4), log_scales=torch.randn(count, 3),
        opacity_logits={RGB: torch.randn(count, 1), THERMAL: torch.randn(count, 1)},
        sh_dc={RGB: torch.randn(count, 1, 3), THERMAL: torch.randn(count, 1, 1)},
        sh_rest={RGB: 0.3 * torch.randn(count, 15, 3),
                 THERMAL: 0.3 * torch.randn(count, bands, 1)},
        embedding=field.initial_embedding(means),
    )  # fmt: skip
    return field, gaussians, nearest_neighbours(means, k) if k else None


def values_and_gradients(field, gaussians, neighbours, rows, degree=3) -> dict[str, torch.Tensor]:
    """Colours, temperatures, and the gradient of everything that they depend on, by name."""
    dtype = gaussians.means.dtype
    gaussians = Gaussians.from_tensors(
        {name: tensor.clone().requires_grad_() for name, tensor in gaussians.tensors().items()}
    )
    camera = CAMERA.to(dtype, copy=True).requires_grad_()
    colors = field.colors(gaussians, camera, degree, rows)
    temperatures = field.temperatures(gaussians, neighbours, camera, degree, rows)
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(t.shape, generator=generator).to(dtype) for t in (colors, temperatures)]
    leaves = {**gaussians.tensors(), **dict(field.named_parameters()), "camera": camera}
    loss = (colors * weights[0]).sum() + (temperatures * weights[1]).sum()
    grads = torch.autograd.grad(loss, leaves.values(), allow_unused=True, materialize_grads=True)
    return {"colors": colors, "temperatures": temperatures, **dict(zip(leaves, grads, strict=True))}


def in_float64(field: RadianceField, gaussians: Gaussians) -> tuple[RadianceField, Gaussians]:
    tensors = {name: tensor.double() for name, tensor in gaussians.tensors().items()}
    return copy.deepcopy(field).double(), Gaussians.from_tensors(tensors)


def assert_same(case, rows, degree=3):
    field, gaussians, neighbours = case
    found = values_and_gradients(field, gaussians, neighbours, rows, degree)
    expected = values_and_gradients(*in_float64(field, gaussians), neighbours, rows, degree)
    for name, value in expected.items():
        error = (found[name].double() - value).norm()
        assert error <= 2e-6 * value.norm(), f"{name}: {error / value.norm():.1e}"


OPTIONS = [
    {},
    {"neighbours_n": 1},
    {"neighbours_n": 5, "thermal_feature_width": 7},
    {"fourier": False, "hidden_width": 20, "embedding_width": 6},
    {"direction_frequencies": 0, "position_frequencies": 0, "embedding_width": 30},
    {"bands": 0},
    {"residuals": False},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("some", [True, False])
def test_kernels_are_the_plain_code(options, some):
    generator = torch.Generator().manual_seed(2)
    rows = torch.randperm(150, generator=generator)[:101] if some else None
    assert_same(make_case(**options), rows)


@pytest.mark.parametrize("count", [1, 31, 32, 33])
def test_blocks_need_not_be_full(count):
    assert_same(make_case(40), torch.arange(count))


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_degrees_of_the_harmonics(degree):
    assert_same(make_case(60), None, degree)


def test_no_rows():
    field, gaussians, neighbours = make_case()
    none = torch.empty(0, dtype=torch.int64)
    found = values_and_gradients(field, gaussians, neighbours, none)
    assert found["colors"].shape == (0, 3)
    assert found["temperatures"].shape == (0, 1)
    assert not found["thermal_head.mlp.0.weight"].any()


def test_bits_do_not_depend_on_the_number_of_threads():
    """At sizes from which torch and BLAS split their sums."""
    field, gaussians, neighbours = make_case(40_000)
    rows = torch.arange(0, 40_000, 2).flip(0)
    threads = torch.get_num_threads(), numba.get_num_threads()
    results = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
            results.append(values_and_gradients(field, gaussians, neighbours, rows))
    finally:
        torch.set_num_threads(threads[0])
        numba.set_num_threads(threads[1])
    for name, value in results[0].items():
        assert torch.equal(value, results[1][name]), name


def test_passes_do_not_share_what_they_keep():
    """A second forward before the first backward, and two backwards of one forward."""
    field, gaussians, neighbours = make_case()
    gaussians = dataclasses.replace(gaussians, embedding=gaussians.embedding.requires_grad_())
    other = dataclasses.replace(gaussians, embedding=-gaussians.embedding.detach())

    def both(which):
        return (
            field.colors(which, CAMERA, 3).sum()
            + field.temperatures(which, neighbours, CAMERA, 3).sum()
        )

    (expected,) = torch.autograd.grad(both(gaussians), gaussians.embedding)
    loss = both(gaussians)
    both(other)
    (first,) = torch.autograd.grad(loss, gaussians.embedding, retain_graph=True)
    both(other)
    (second,) = torch.autograd.grad(loss, gaussians.embedding)
    assert torch.equal(first, expected)
    assert torch.equal(second, expected)


@pytest.mark.parametrize("name", ["embedding", "sh_dc.rgb", "means", "opacity_logit.thermal"])
def test_what_is_not_finite_is_not_hidden(name):
    field, gaussians, neighbours = make_case()
    gaussians.tensors()[name][7] = torch.nan
    found = values_and_gradients(field, gaussians, neighbours, None)
    assert any(
        not value.isfinite().all()
        for key, value in found.items()
        if key in ("colors", "temperatures")
    )


def test_a_gaussian_at_the_camera_has_a_colour_and_a_finite_gradient():
    means = CAMERA[None].clone().requires_grad_()
    value = shade(means, torch.zeros(1, 1, 3), torch.ones(1, 15, 3), CAMERA, 3, torch.arange(1))
    value.sum().backward()
    assert value.isfinite().all()
    assert means.grad.isfinite().all()


def test_little_is_kept_without_gradients():
    assert slots(500_000, keep=False) == SHARES
