from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from mrgs.field.spherical_harmonics import C0, evaluate_sh


def basis_values(directions: torch.Tensor) -> torch.Tensor:
    """All 16 basis functions at each direction, [N, 16], read off with unit coefficients."""
    count = len(directions)
    coefficients = torch.eye(16, dtype=torch.float64).expand(count, 16, 16)
    return evaluate_sh(coefficients[:, :1], coefficients[:, 1:], directions, 3)


def real_harmonic(degree: int, order: int, directions: np.ndarray) -> np.ndarray:
    x, y, z = directions.T
    value = sph_harm_y(degree, abs(order), np.arccos(z), np.arctan2(y, x))
    if order == 0:
        return value.real
    return math.sqrt(2) * (value.real if order > 0 else value.imag)


def random_directions(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.nn.functional.normalize(
        torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=1
    )


def test_basis_agrees_with_scipy():
    directions = random_directions(50)
    expected = [
        real_harmonic(degree, order, directions.numpy())
        for degree in range(4)
        for order in range(-degree, degree + 1)
    ]
    np.testing.assert_allclose(
        basis_values(directions).numpy(), np.stack(expected, axis=1), atol=1e-12
    )


def test_basis_is_orthonormal():
    nodes, weights = np.polynomial.legendre.leggauss(8)
    azimuths = np.arange(16) * 2 * np.pi / 16
    z, azimuth = (grid.ravel() for grid in np.meshgrid(nodes, azimuths, indexing="ij"))
    radius = np.sqrt(1 - z**2)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    quadrature = torch.from_numpy(np.repeat(weights, 16) * 2 * np.pi / 16)
    basis = basis_values(torch.from_numpy(directions))
    torch.testing.assert_close(
        basis.T @ (quadrature[:, None] * basis), torch.eye(16, dtype=torch.float64)
    )


@pytest.mark.parametrize(("degree", "bands"), [(0, 0), (1, 3), (2, 8), (3, 15)])
def test_degree_cuts_the_higher_bands(degree, bands):
    dc, rest, directions = torch.randn(6, 1, 3), torch.randn(6, 15, 3), random_directions(6).float()
    cut = rest.clone()
    cut[:, bands:] = 0
    torch.testing.assert_close(
        evaluate_sh(dc, rest, directions, degree), evaluate_sh(dc, cut, directions, 3)
    )


def test_missing_bands_count_as_zero():
    dc, directions = torch.randn(6, 1, 1), random_directions(6).float()
    torch.testing.assert_close(evaluate_sh(dc, torch.empty(6, 0, 1), directions, 3), C0 * dc[:, 0])


def test_gradient():
    inputs = [
        torch.randn(3, *shape, dtype=torch.float64, requires_grad=True)
        for shape in ((1, 2), (15, 2), (3,))
    ]
    assert torch.autograd.gradcheck(
        lambda dc, rest, directions: evaluate_sh(dc, rest, directions, 3), inputs
    )


def test_coefficients_that_do_not_count_have_a_gradient_of_zero():
    """Adam goes on with its momentum then, whichever code gave the gradient."""
    dc, rest = torch.ones(5, 1, 3, requires_grad=True), torch.ones(5, 15, 3, requires_grad=True)
    evaluate_sh(
        dc, rest, torch.nn.functional.normalize(torch.ones(5, 3), dim=1), 0
    ).sum().backward()
    assert not rest.grad.any()
