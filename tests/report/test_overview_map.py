"""The map of a façade or of a plant in the report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrgs.errors import RunError
from mrgs.maps.draw import MARGIN
from mrgs.marks import Mark, Marks
from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.regions import Regions
from mrgs.pictures.palette import palette_table
from mrgs.report.overview import (
    MARK,
    MOST_PX,
    TemperatureMap,
    draw_temperature_map,
    temperature_map,
)
from mrgs.scene import THERMAL, WorldFrame
from tests.maps.conftest import CELSIUS

EYE = (0.0, -7.0, 1.6)


@pytest.fixture(scope="module")
def drawn(front, front_scene) -> TemperatureMap:
    """The map of the house front; only to be looked at."""
    return draw_temperature_map(front, front_scene)


def mark(name: str, x: float, z: float, y: float = 0.0) -> Mark:
    return Mark(name, "spot", ((x, y, z),), EYE, 0.05)


def differs(one, other) -> np.ndarray:
    """Rows and columns of what is drawn in one picture and not in the other."""
    assert one.size == other.size
    return np.argwhere((np.asarray(one) != np.asarray(other)).any(axis=2))


@pytest.mark.slow
def test_areas_with_an_emissivity_of_their_own_are_corrected_as_the_marks_are(
    front, front_scene, drawn
):
    corners = ((-0.7, 0.0, 1.0), (0.7, 0.0, 1.0), (0.7, 0.0, 3.0), (-0.7, 0.0, 3.0))
    area = Mark("B1", "box", corners, (0.0, -6.0, 2.0), emissivity=0.3, reflected_c=-5.0)
    regions = Regions(
        Marks((area,)), lambda camera: front.render(camera, THERMAL), CELSIUS, CaptureSettings()
    )
    plain = drawn.drawn.bands[0]
    own = draw_temperature_map(front, front_scene, regions).drawn.bands[0]
    changed = ~np.isclose(plain, own, equal_nan=True)
    assert changed.sum() > 100
    wanted = CaptureSettings().corrected(
        plain[changed].astype(np.float64), SurfaceSettings(0.3, -5.0)
    )
    np.testing.assert_allclose(own[changed], wanted, atol=1e-3)


def test_the_facade_is_to_scale_and_has_the_marks_at_their_places(drawn):
    plain = drawn.picture({})
    assert drawn.from_the_front
    assert not drawn.north
    grid = drawn.drawn.grid
    width_m, height_m = grid.width * grid.pixel_m, grid.height * grid.pixel_m
    assert 7.5 < width_m < 9
    assert 4.5 < height_m < 6
    left, right = (
        differs(
            drawn.picture({"1": mark("1", x, 2.0)}),
            plain,
        )
        for x in (-2.0, 2.0)
    )
    body = plain.height - 2 * MARGIN - 58
    metres = height_m / body
    moved = (right[:, 1].min() - left[:, 1].min()) * metres
    assert moved == pytest.approx(4.0, abs=0.03)
    np.testing.assert_array_equal(np.unique(left[:, 0]), np.unique(right[:, 0]))


def test_what_is_not_on_the_map_is_not_drawn(drawn):
    plain = drawn.picture({})
    away = {"before": mark("before", 0, 2, -3.0), "beside": mark("beside", 40.0, 2.0)}
    assert not any(map(drawn.shows, away.values()))
    assert not len(differs(drawn.picture(away), plain))


def test_the_small_map_shows_the_wall_in_its_colours_and_the_mark(drawn):
    small = np.asarray(drawn.small(mark("1", 2.0, 2.0))).astype(int)
    wall = np.abs(small - (0.3 * 255 + 0.7 * 255 * np.array([0.8, 0.5, 0.2]))).max(axis=2) < 6
    assert wall.mean() > 0.9
    dot = np.argwhere(np.abs(small - MARK).max(axis=2) < 30)
    width_m = drawn.drawn.grid.width * drawn.drawn.grid.pixel_m
    x = width_m / small.shape[1] * (dot[:, 1].mean() - small.shape[1] / 2)
    assert x == pytest.approx(2.0, abs=0.1)


def test_what_the_small_map_does_not_show_is_white(drawn):
    bands = drawn.drawn.bands.copy()
    bands[:, :, : bands.shape[2] // 2] = np.nan
    half = replace(drawn, drawn=replace(drawn.drawn, bands=bands))
    small = np.asarray(half.small(mark("1", 2.0, 2.0)))
    assert (small[:, : small.shape[1] // 2 - 5] == 255).all()


def test_warm_windows_are_warm_in_the_picture(drawn):
    picture = np.asarray(drawn.picture({}))
    warmest = palette_table("inferno")[-20:]
    body = picture[MARGIN:-94, MARGIN:-150]
    warm = np.isin(body.astype(int) @ [65536, 256, 1], warmest.astype(int) @ [65536, 256, 1])
    assert 0.12 < warm.mean() < 0.3  # two windows of 4 m² on 40 m²
    assert max(body.shape[:2]) <= MOST_PX


class Unused:
    """Of scenes without a map nothing is baked."""


@pytest.mark.parametrize("changes", [{"world": WorldFrame()}, {"temperature": None}])
def test_without_metres_or_celsius_there_is_no_map(front_scene, changes):
    assert temperature_map(Unused(), replace(front_scene, **changes), Unused()) is None


def test_a_scene_seen_from_all_sides_has_no_map(front_scene):
    around = [
        replace(
            view, images={m: replace(i, camera=turned(i.camera, k)) for m, i in view.images.items()}
        )
        for k, view in enumerate(front_scene.train)
    ]
    assert temperature_map(Unused(), replace(front_scene, train=tuple(around)), Unused()) is None


def turned(camera, k: int):
    """The camera on a circle about the scene."""
    angle = 2 * np.pi * k / 7
    return camera.look_at((6 * np.cos(angle), 6 * np.sin(angle), 3.0), (0.0, 0.0, 1.0))


def test_a_scene_without_a_wall_says_so(front, front_scene):
    ground = front.map_tensors(lambda tensor: tensor[front.means[:, 2] < 0.05])
    with pytest.raises(RunError, match="façade"):
        draw_temperature_map(ground, front_scene)
