"""What is said of a façade beside its map."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from mrgs.export.maps import elevation_texts
from mrgs.maps.draw import OrthographicMap
from mrgs.maps.surfaces import MapGrid
from mrgs.scene import WorldFrame


@pytest.mark.parametrize(
    ("azimuth", "words"),
    [
        (0.0, "faces north (0°)"),
        (40.0, "faces north-east (40°)"),
        (92.0, "faces east (92°)"),
        (179.0, "faces south (179°)"),
        (250.0, "faces west (250°)"),
        (340.0, "faces north (340°)"),
    ],
)
def test_a_facade_faces_a_point_of_the_compass(azimuth, words):
    east, north = math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))
    axes = np.array([[-north, east, 0.0], [0.0, 0.0, 1.0], [east, north, 0.0]])
    grid = MapGrid(axes, 1.0, np.zeros(2), 0.0, 2.0, 0.05, 60, 40, (-1.0, 1.0))
    drawn = OrthographicMap(
        grid, np.ones((7, 40, 60), np.float32), np.zeros((40, 60, 3), np.float32)
    )
    scene = SimpleNamespace(name="house", world=WorldFrame(metric=True, north=True))
    caption, facts = elevation_texts(scene, drawn)
    size, facing, pixel = caption.subtitle.split(" · ")
    assert (size, facing) == ("3 × 2 m", words)
    assert pixel.startswith("5 cm ")
    assert float(facts["faces_azimuth_deg"]) == azimuth
    scene.world = WorldFrame(metric=True)
    caption, facts = elevation_texts(scene, drawn)
    assert caption.subtitle.split(" · ") == [size, pixel]
    assert "faces_azimuth_deg" not in facts
