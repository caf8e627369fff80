from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import k0

from mrgs_synth.conduction import Contact, Plate, solve

IMPOSED = 1e6


def test_straight_edge_decays_exponentially() -> None:
    plate = Plate(1.2, 0.04, spread_m=0.05, ambient_c=20.0)
    x, _ = plate.cell_centres()
    solved = solve(plate, [Contact(x < -0.4, 70.0, IMPOSED)])
    beyond = x[0] > -0.4
    # The last imposed cell's centre holds the temperature: half a cell before the contact's edge.
    expected = 20.0 + 50.0 * np.exp(-(x[0, beyond] + 0.402) / 0.05)
    np.testing.assert_allclose(solved.grid_c[0, beyond], expected, atol=0.15)


def test_disc_decays_as_a_bessel_function() -> None:
    plate = Plate(0.8, 0.8, spread_m=0.05, ambient_c=0.0)
    x, y = plate.cell_centres()
    radius = np.hypot(x, y)
    solved = solve(plate, [Contact(radius < 0.1, 1.0, IMPOSED)])
    ring = (radius > 0.105) & (radius < 0.3)
    np.testing.assert_allclose(
        solved.grid_c[ring], k0(radius[ring] / 0.05) / k0(0.1 / 0.05), atol=0.04
    )


@settings(deadline=None, max_examples=20)
@given(
    st.lists(
        st.tuples(st.floats(-0.2, 0.2), st.floats(-20.0, 90.0), st.floats(0.1, 50.0)),
        min_size=1,
        max_size=3,
    )
)
def test_heat_is_balanced_and_bounded(contacts: list[tuple[float, float, float]]) -> None:
    plate = Plate(0.4, 0.1, spread_m=0.03, ambient_c=20.0, cell_m=0.01)
    x, _ = plate.cell_centres()
    placed = [
        Contact(np.abs(x - centre) < 0.03, celsius, coupling)
        for centre, celsius, coupling in contacts
    ]
    grid = solve(plate, placed).grid_c
    lost = (grid - 20.0).sum()
    gained = sum(
        (contact.coupling * contact.cells * (contact.temperature_c - grid)).sum()
        for contact in placed
    )
    assert gained == pytest.approx(lost, abs=1e-6)
    temperatures = [20.0, *(contact.temperature_c for contact in placed)]
    assert min(temperatures) - 1e-9 <= grid.min() <= grid.max() <= max(temperatures) + 1e-9


def test_coupling_of_one_is_half_way() -> None:
    plate = Plate(0.1, 0.1, spread_m=0.03, ambient_c=20.0)
    everywhere = np.ones(plate.shape, dtype=bool)
    np.testing.assert_allclose(solve(plate, [Contact(everywhere, 60.0, 1.0)]).grid_c, 40.0)


def test_lookup_interpolates_at_world_positions() -> None:
    plate = Plate(0.4, 0.2, spread_m=0.05, ambient_c=20.0)
    x, y = plate.cell_centres()
    solved = solve(plate, [Contact((x > 0.1) & (y < 0.0), 60.0, 5.0)])
    centres = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    np.testing.assert_allclose(solved.at(centres), solved.grid_c.ravel())
    assert (
        solved.at(np.array([[0.15, -0.05, 0.0]])) > solved.at(np.array([[-0.15, 0.05, 0.0]])) + 10.0
    )
