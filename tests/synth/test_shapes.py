from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs_synth.shapes import Mesh, box, lathe, merge, sphere, tube


def is_closed(mesh: Mesh) -> bool:
    """Each edge is walked once in each direction, once the seams are welded."""
    _, welded = np.unique(np.round(mesh.vertices, 7), axis=0, return_inverse=True)
    faces = welded.ravel()[mesh.faces]
    edges = Counter(
        map(tuple, np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist())
    )
    return all(count == 1 and edges[(b, a)] == 1 for (a, b), count in list(edges.items()))


def volume(mesh: Mesh) -> float:
    """Positive if the faces point outwards."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def normal_agreement(mesh: Mesh) -> float:
    """The smallest cosine between a face's normal and those of its corners."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return float(np.einsum("fd,fkd->fk", normal, mesh.normals[mesh.faces]).min())


def cylinder(radius: float, height: float) -> Mesh:
    return lathe(
        [(0.0, 0.0), (radius, 0.0)],
        [(radius, 0.0), (radius, height)],
        [(radius, height), (0.0, height)],
    )


BEND = np.linspace(0.0, 2.0, 30)
ARC = np.stack([np.cos(BEND), 0.0 * BEND, np.sin(BEND)], axis=-1)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (box(0.2, 0.3, 0.4), 0.2 * 0.3 * 0.4),
        (sphere(0.5), 4 / 3 * np.pi * 0.5**3),
        (cylinder(0.3, 0.5), np.pi * 0.3**2 * 0.5),
        (tube(ARC, 0.1), np.pi * 0.1**2 * 2.0),
        (merge([box(0.1, 0.1, 0.1), box(0.1, 0.1, 0.1).placed(1.0, 0.0, 0.0)]), 0.002),
    ],
    ids=["box", "sphere", "cylinder", "tube", "two boxes"],
)
def test_meshes_are_closed_and_point_outwards(mesh: Mesh, expected: float) -> None:
    assert is_closed(mesh)
    assert volume(mesh) == pytest.approx(expected, rel=0.03)
    assert normal_agreement(mesh) > 0.95
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-9)
    assert mesh.uv.min() >= 0.0
    assert mesh.uv.max() <= 1.0


@settings(deadline=None, max_examples=25)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3), st.floats(-360, 360))
def test_placing_keeps_shape(x: float, y: float, z: float, yaw_deg: float) -> None:
    mesh = cylinder(0.3, 0.5)
    placed = mesh.placed(x, y, z, yaw_deg)
    assert volume(placed) == pytest.approx(volume(mesh), rel=1e-6)
    assert normal_agreement(placed) == pytest.approx(normal_agreement(mesh), abs=1e-9)
    np.testing.assert_allclose(
        placed.vertices.mean(axis=0) - mesh.vertices.mean(axis=0), [x, y, z], atol=0.05
    )


def test_yaw_is_counter_clockwise_from_above() -> None:
    turned = box(1.0, 0.1, 0.1).placed(0.0, 0.0, 0.0, 90.0)
    np.testing.assert_allclose(np.ptp(turned.vertices, axis=0), [0.1, 1.0, 0.1], atol=1e-12)


def test_inside_out_faces_the_other_way() -> None:
    mesh = box(1.0, 1.0, 1.0).inside_out()
    assert is_closed(mesh)
    assert volume(mesh) == pytest.approx(-1.0)
    assert normal_agreement(mesh) == pytest.approx(1.0)
