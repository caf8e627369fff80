from __future__ import annotations

import numpy as np

from mrgs.scene import point_cloud as module
from mrgs.scene.point_cloud import coincident_points, spare_points


def test_crowds_are_places_with_many_points():
    places = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 2]])
    which = np.array([0, 1, 2, 1, 0, 1, 1, 0, 1, 0])
    points = places[which]
    points[4] *= -1.0  # -0 is the same place
    found = coincident_points(points, 1, most=3)
    assert [each.tolist() for each in found] == [[0, 4, 7, 9], [1, 3, 5, 6, 8]]
    assert [each.tolist() for each in coincident_points(points, 4, most=3)] == [[1, 3, 5, 6, 8]]
    assert spare_points(found, 3).tolist() == [9, 6, 8]


def test_without_crowds_none_are_spare():
    points = np.zeros((module.CROWDED, 3))
    assert coincident_points(points, 1) == []
    assert spare_points([], 1).tolist() == []
