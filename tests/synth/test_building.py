from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from mrgs_synth.building import (
    Opening,
    beam,
    frustum,
    pane,
    pierced_wall,
    prism,
    reveal,
    rod,
    window_frame,
)
from mrgs_synth.shapes import Mesh

WINDOW = Opening("window", 0.5, 0.8, 1.0, 1.4)
DOOR = Opening("door", -1.0, 0.0, 0.9, 2.0)
GABLE = np.array([(-1.0, 0.0), (1.0, 0.0), (1.0, 2.0), (0.0, 3.0), (-1.0, 2.0)])


def corners(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces].transpose(1, 0, 2)


def area(mesh: Mesh) -> float:
    a, b, c = corners(mesh)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def volume(mesh: Mesh) -> float:
    """Positive if the faces point outwards."""
    a, b, c = corners(mesh)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def faces_along_normals(mesh: Mesh) -> bool:
    a, b, c = corners(mesh)
    return bool(
        (np.einsum("fd,fd->f", np.cross(b - a, c - a), mesh.normals[mesh.faces[:, 0]]) > 0.0).all()
    )


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (beam(-1.0, 2.0, 0.5, 1.0, 3.0, 3.5), 0.75),
        (prism(GABLE, 4.0), 20.0),
        (frustum((2.0, 1.0), (2.0, 1.0), 0.5), 1.0),
        (frustum((2.0, 2.0), (1.0, 1.0), 3.0, 0.25), 7.0),
        (rod((0.0, 0.0, 0.0), (3.0, 4.0, 0.0), 0.1, 64), np.pi * 0.05),
    ],
    ids=["beam", "prism", "box", "frustum", "rod"],
)
def test_solids_are_closed_and_point_outwards(mesh: Mesh, expected: float) -> None:
    assert volume(mesh) == pytest.approx(expected, rel=0.01)
    assert faces_along_normals(mesh)
    _, welded = np.unique(np.round(mesh.vertices, 7), axis=0, return_inverse=True)
    faces = welded.ravel()[mesh.faces]
    edges = Counter(
        map(tuple, np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist())
    )
    assert all(edges[(b, a)] == count for (a, b), count in list(edges.items()))


def test_a_wall_has_holes_where_its_openings_are() -> None:
    wall = pierced_wall(4.0, 3.0, [WINDOW, DOOR])
    assert area(wall) == pytest.approx(4.0 * 3.0 - 1.0 * 1.4 - 0.9 * 2.0)
    assert faces_along_normals(wall)
    assert (wall.normals == [0.0, -1.0, 0.0]).all()
    centres = wall.vertices[wall.faces].mean(axis=1)
    for opening in (WINDOW, DOOR):
        inside = (np.abs(centres[:, 0] - opening.x) < opening.width / 2) & (
            (centres[:, 2] > opening.z) & (centres[:, 2] < opening.top)
        )
        assert not inside.any()


def test_the_texture_of_a_wall_runs_on_behind_its_openings() -> None:
    wall = pierced_wall(4.0, 3.0, [WINDOW, DOOR])
    np.testing.assert_allclose(wall.uv[:, 0], wall.vertices[:, 0] / 4.0 + 0.5)
    np.testing.assert_allclose(wall.uv[:, 1], wall.vertices[:, 2] / 3.0)


def test_a_reveal_and_a_pane_close_an_opening() -> None:
    sides = reveal(WINDOW, 0.2)
    assert area(sides) == pytest.approx(0.2 * 2 * (1.0 + 1.4))
    assert faces_along_normals(sides)
    middle = np.array([WINDOW.x, 0.1, WINDOW.z + 0.7])
    assert (
        np.einsum("vd,vd->v", middle - sides.vertices, sides.normals) > 0.0
    ).all()  # seen from within
    glass = pane(WINDOW, 0.2)
    assert area(glass) == pytest.approx(1.4)
    np.testing.assert_allclose(glass.vertices[:, 1], 0.2)


def test_a_window_frame_fills_its_opening_and_leaves_the_panes_free() -> None:
    frame = window_frame(WINDOW, 0.1, (2, 2))
    np.testing.assert_allclose(frame.vertices.min(axis=0), [WINDOW.left, 0.1, WINDOW.z])
    np.testing.assert_allclose(frame.vertices.max(axis=0), [WINDOW.right, 0.18, WINDOW.top])
    bars = area(frame) - area(window_frame(WINDOW, 0.1, (1, 1)))
    assert bars > 0.0
    pane_centre = np.array([WINDOW.x - 0.25, WINDOW.z + 0.35])
    a, b, c = (corner[:, [0, 2]] for corner in corners(frame))
    sides = [_turn(q - p, pane_centre - p) for p, q in ((a, b), (b, c), (c, a))]
    inside = (np.minimum.reduce(sides) > 0.0) | (np.maximum.reduce(sides) < 0.0)
    assert not inside.any()


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
