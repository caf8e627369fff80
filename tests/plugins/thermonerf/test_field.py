from __future__ import annotations

import math

import torch

from mrgs_thermonerf.networks import (
    Field,
    GridSize,
    density_of,
    harmonics_of,
)


def test_densities_are_positive_and_finite():
    densities = density_of(torch.tensor([-1e4, 0.0, 1.0, 1e4]))
    torch.testing.assert_close(densities, torch.tensor([0.0, math.exp(-1), 1.0, math.exp(10)]))


def test_the_harmonics_are_orthonormal_on_the_sphere():
    directions = torch.nn.functional.normalize(
        torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    functions = harmonics_of(directions)
    products = 4 * math.pi * functions.T @ functions / len(directions)
    torch.testing.assert_close(products, torch.eye(16), rtol=0, atol=0.03)


def test_colour_depends_on_the_view_and_temperature_cannot():
    torch.manual_seed(0)
    field = Field(GridSize(2, 4, 8, 10), units=16)
    densities, features = field.density(torch.rand(5, 3))
    assert densities.shape == (5,)
    toward = [
        harmonics_of(torch.tensor([axis]).expand(5, 3)) for axis in ([1.0, 0, 0], [0, 0, 1.0])
    ]
    colors = [field.color(features, harmonics) for harmonics in toward]
    assert (colors[0] - colors[1]).abs().min() > 1e-4
    temperatures = field.temperature(features)
    assert temperatures.shape == (5, 1)
    assert ((temperatures > 0) & (temperatures < 1)).all()


def test_both_heads_reach_the_shared_density_network():
    field = Field(GridSize(2, 4, 8, 10), units=16)
    positions = torch.rand(5, 3)
    harmonics = harmonics_of(torch.tensor([[1.0, 0, 0]]).expand(5, 3))
    for head in (lambda f: field.color(f, harmonics), field.temperature):
        field.zero_grad()
        head(field.density(positions)[1]).sum().backward()
        assert field.grid.table.grad.abs().max() > 0
