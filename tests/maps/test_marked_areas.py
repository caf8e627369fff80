"""A map of a wall of which an area has an emissivity of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrgs.maps.draw import OrthographicMap, draw_map
from mrgs.maps.facade import facade_grid
from mrgs.maps.options import MapOptions
from mrgs.maps.surfaces import seen_surfaces
from mrgs.marks import Mark, Marks
from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.photo_readings import PhotoReadings
from mrgs.marks.regions import Regions
from mrgs.marks.uncertainty import UncertaintyMeter
from mrgs.scene import THERMAL, ideal_cameras
from mrgs.survey import Survey
from tests.maps.conftest import CELSIUS

LEFT, RIGHT, LOW, HIGH = -0.7, 0.7, 1.0, 3.0
CORNERS = ((LEFT, 0.0, LOW), (RIGHT, 0.0, LOW), (RIGHT, 0.0, HIGH), (LEFT, 0.0, HIGH))
AREA = Mark("B1", "box", CORNERS, (0.0, -6.0, 2.0), emissivity=0.3, reflected_c=-5.0)
OWN = SurfaceSettings(0.3, -5.0)
OPTIONS = MapOptions(pixel_size_m=0.05, plane=((-3.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 0.0, 4.0)))

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def maps(front, front_scene):
    """The wall of wide splats without and with the area, and what its pixels show of it."""
    wide = replace(front, scales=front.scales * 3)
    seen = seen_surfaces(wide, front_scene)
    readings = PhotoReadings(wide.render, ideal_cameras, front_scene.train, CELSIUS)
    meter = UncertaintyMeter.of(readings, front_scene, CELSIUS, Survey())
    regions = Regions(
        Marks((AREA,)), lambda camera: wide.render(camera, THERMAL), CELSIUS, CaptureSettings()
    )

    def drawn(corrected: bool) -> OrthographicMap:
        def appraise(points, celsius):
            around = meter.of_points(points, celsius, regions if corrected else None)
            return regions.corrected_at(points, celsius) if corrected else celsius, around

        return draw_map(wide, front_scene, seen, facade_grid(front_scene, seen, OPTIONS), appraise)

    plain, own = drawn(False), drawn(True)
    grid = plain.grid
    u, v = (middles - low for middles, low in zip(grid.middles, grid.offset, strict=True))
    x, z = np.meshgrid(u, v)

    def within(margin: float) -> np.ndarray:
        across = (x > LEFT + margin) & (x < RIGHT - margin)
        return across & (z > LOW + margin) & (z < HIGH - margin)

    return plain.bands, own.bands, within(0.05), ~within(-0.05)


def test_what_cameras_see_of_it_is_corrected_and_nothing_else(maps):
    plain, own, inside, outside = maps
    assert inside.sum() > 500
    wanted = CaptureSettings().corrected(plain[0][inside].astype(np.float64), OWN)
    np.testing.assert_allclose(own[0][inside], wanted, atol=1e-3)
    np.testing.assert_array_equal(own[0][outside], plain[0][outside])
    np.testing.assert_array_equal(own[1:6], plain[1:6])


def test_its_uncertainty_is_that_of_its_settings(maps):
    plain, own, inside, outside = maps
    np.testing.assert_array_equal(own[6][outside], plain[6][outside])
    assert (own[6][inside] > plain[6][inside] + 1).all()
