from __future__ import annotations

import numpy as np

from mrgs_synth.boxtree import BoxTree
from mrgs_synth.hits import Triangles
from mrgs_synth.stage import Stage


def test_the_tree_finds_what_every_triangle_alone_finds() -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1.0, 1.0, (60, 1, 3)) + rng.uniform(-0.3, 0.3, (60, 3, 3))
    origins, directions = rng.uniform(-2.0, 2.0, (300, 3)), rng.normal(size=(300, 3))
    directions[::2] = rng.uniform(-0.6, 0.6, (150, 3)) - origins[::2]
    directions[:30, 0] = 0.0  # along a plane of the boxes
    alone = [BoxTree.of(corners[f : f + 1]).cast(origins, directions)[0] for f in range(60)]
    distance, triangle = BoxTree.of(corners).cast(origins, directions)
    assert 30 < np.isfinite(distance).sum() < 270
    np.testing.assert_array_equal(distance, np.min(alone, axis=0))
    hit = triangle >= 0
    np.testing.assert_array_equal(hit, np.isfinite(distance))
    np.testing.assert_array_equal(triangle[hit], np.argmin(alone, axis=0)[hit])


def test_distances_are_those_of_geometry(two_boxes: Stage) -> None:
    triangles = Triangles.of(two_boxes.solids)
    origins = np.array([[5.0, 5.0, 3.0], [0.1, 0.0, 3.0], [0.1, 0.0, 3.0]])
    directions = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -2.0], [0.0, 0.0, 1.0]])
    distance, triangle = triangles.tree.cast(origins, directions)
    np.testing.assert_allclose(distance[:2], [3.0, 1.4])
    assert triangles.solid[triangle[:2]].tolist() == [0, 1]
    assert np.isinf(distance[2])
    assert triangle[2] == -1
