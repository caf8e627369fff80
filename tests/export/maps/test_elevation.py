"""What is said of a façade beside its map."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from mrgs.export import elevation
from mrgs.export.maps.draw import OrthographicMap
from mrgs.export.maps.facade import Facade
from mrgs.export.maps.grid import MapGrid
from mrgs.export.maps.picture import Caption
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
def test_a_facade_faces_a_point_of_the_compass(azimuth, words, monkeypatch):
    east, north = math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))
    axes = np.array([[-north, east, 0.0], [0.0, 0.0, 1.0], [east, north, 0.0]])
    grid = MapGrid(axes, 1.0, np.zeros(2), 0.0, 2.0, 0.05, 60, 40, (-1.0, 1.0))
    drawn = OrthographicMap(grid, np.ones((7, 40, 60), np.float32))
    facade = Facade(axes, np.zeros(3), np.array([3.0, 2.0, 1.0]))
    monkeypatch.setattr(elevation, "facade_map", lambda *args, **options: (drawn, facade))
    captions: list[Caption] = []
    facts: list[dict] = []

    def write_map(job, name, drawn, wkt, caption, more):
        captions.append(caption)
        facts.append(more)
        return []

    monkeypatch.setattr(elevation, "write_map", write_map)
    scene = SimpleNamespace(name="house", world=WorldFrame(metric=True, north=True))
    job = SimpleNamespace(scene=scene, baked=None, maps=None, uncertainty=None, regions=None)
    elevation.export(job)
    assert captions[0].subtitle == f"3 × 2 m · {words} · 5 cm per pixel"
    assert float(facts[0]["faces_azimuth_deg"]) == azimuth
    scene.world = WorldFrame(metric=True)
    elevation.export(job)
    assert captions[1].subtitle == "3 × 2 m · 5 cm per pixel"
