from __future__ import annotations

import numpy as np
import pytest

from mrgs.export.mesh import surface_nets


def ball(size: int = 20, radius: float = 6.3) -> np.ndarray:
    """Distance from a sphere in the middle of a cube."""
    centre = (size - 1) / 2
    return np.linalg.norm(np.indices((size, size, size)) - centre, axis=0) - radius


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return (a * np.cross(b, c)).sum() / 6


def test_a_sphere_is_closed_round_and_faces_outwards():
    vertices, faces = surface_nets(ball())
    radii = np.linalg.norm(vertices - 9.5, axis=1)
    assert np.abs(radii - 6.3).max() < 0.15
    assert volume(vertices - 9.5, faces) == pytest.approx(4 / 3 * np.pi * 6.3**3, rel=0.03)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert len(vertices) - len(edges) / 2 + len(faces) == 2  # Euler


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_a_plane_lies_where_the_values_cross_zero_and_faces_the_positive_side(axis, sign):
    values = sign * (np.indices((5, 6, 7))[axis] - 2.25)
    vertices, faces = surface_nets(values)
    np.testing.assert_allclose(vertices[:, axis], 2.25)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    assert (np.sign(normals[:, axis]) == sign).all()
    others = [size - 2 for i, size in enumerate(values.shape) if i != axis]
    assert len(faces) == 2 * others[0] * others[1]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_plane_may_go_through_samples(sign):
    vertices, faces = surface_nets(sign * (np.indices((5, 6, 7))[0] - 2.0))
    np.testing.assert_allclose(vertices[:, 0], 2.0)
    assert len(faces) == 2 * 4 * 5


def test_nothing_is_drawn_next_to_the_unknown():
    values = ball()
    values[:10] = np.nan
    vertices, faces = surface_nets(values)
    assert vertices[:, 0].min() > 10
    assert len(faces) > 100


def test_without_a_crossing_there_is_no_surface():
    vertices, faces = surface_nets(np.ones((4, 4, 4)))
    assert (len(vertices), len(faces)) == (0, 0)
