"""The modules of generated plants are found in what a perfect model would show from above."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.hot_cells import FAR, Numbers, true_modules
from mrgs.errors import RunError
from mrgs.maps.modules import Modules, _complete, _rows, find_modules
from mrgs_synth.solar_plant.layout import MODULE_M
from tests.helpers.plant_map import Look, PlantMap, map_of, turned_plant

LOOKS = {
    "as drawn": Look(missing=frozenset({(0, 2, 1), (1, 3, 0), (1, 3, 1), (4, 0, 0)})),
    "turned and steep": Look(
        turn_deg=-31.0, tilt_deg=35.0, blur_m=0.07, missing=frozenset({(3, 1, 1)})
    ),
    "from south to north": Look(turn_deg=80.0, tilt_deg=8.0, noise_c=0.3, frames=0.5),
}


def found_in(shown: PlantMap, size_m: tuple[float, float]) -> Modules:
    return find_modules(shown.celsius, shown.colors, shown.points[..., 2], shown.pixel_m, size_m)


def middles(found: Modules, shown: PlantMap) -> dict[Numbers, np.ndarray]:
    """The middles of modules in the plant's coordinates, by their numbers."""
    corner = shown.points[0, 0, :2] - shown.pixel_m / 2 * np.array([1, -1])
    places = found.corners.mean(axis=1) + np.append(corner, 0.0)
    numbers = map(tuple, found.numbers.tolist())
    return dict(zip(numbers, places, strict=True))


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("turned and steep", 72),
        pytest.param("as drawn", 71, marks=pytest.mark.slow),
        pytest.param("from south to north", 73, marks=pytest.mark.slow),
    ],
)
def test_modules_have_their_numbers_and_places(name: str, seed: int) -> None:
    """Of 360 modules none is elsewhere, and none is lost."""
    look = LOOKS[name]
    plant = turned_plant(6, 30, look, seed)
    shown = map_of(plant, look, seed=seed)
    found = found_in(shown, (1.03, 1.72))
    there = {
        numbers: middle
        for numbers, (table, middle) in true_modules(plant).items()
        if table not in look.missing
    }
    placed = middles(found, shown)
    assert placed.keys() == there.keys()
    away = np.array([np.abs(placed[each] - there[each]) for each in there])
    assert np.hypot(*away[:, :2].T).max() < FAR * min(MODULE_M) / 2
    assert np.median(np.hypot(*away[:, :2].T)) < 0.05
    assert np.median(away[:, 2]) < 0.05
    assert found.sides == pytest.approx(MODULE_M, rel=0.05)


def test_modules_across_are_found_too() -> None:
    look = Look(turn_deg=10.0)
    shown = map_of(turned_plant(2, 12, look, 74), look)
    assert len(found_in(shown, MODULE_M[::-1]).numbers) == 48


def test_thermal_photos_alone_show_modules() -> None:
    look = Look()
    shown = map_of(turned_plant(2, 12, look, 75), look)
    found = found_in(shown._replace(colors=np.full_like(shown.colors, np.nan)), MODULE_M)
    assert len(found.numbers) == 48


@pytest.mark.parametrize("size_m", [(0.7, 1.1), (1.3, 2.4)])
def test_another_size_is_refused(size_m: tuple[float, float]) -> None:
    look = Look()
    shown = map_of(turned_plant(2, 12, look, 76), look)
    with pytest.raises(RunError, match="state the"):
        found_in(shown, size_m)


def test_a_meadow_has_no_modules() -> None:
    look = Look(missing=frozenset((0, column, above) for column in range(6) for above in (0, 1)))
    shown = map_of(turned_plant(1, 6, look, 77), look)
    with pytest.raises(RunError, match=r"no grid of modules of 1\.05 × 1\.75 m"):
        found_in(shown, MODULE_M)
    nothing = shown._replace(celsius=np.full_like(shown.celsius, np.nan))
    with pytest.raises(RunError, match="no grid of modules"):
        found_in(nothing, MODULE_M)


def test_pieces_on_the_same_levels_are_one_row() -> None:
    """Two lines of which either piece lacks some, a piece of the second line alone, another row."""
    levels = np.array([0.0, 1.0, 1.0, 0.1, 0.0, 1.1, 1.0, 1.0, 4.0, 5.0])
    piece = np.array([0, 0, 0, 1, 1, 1, 2, 2, 3, 3])
    assert _rows(levels, piece) == {0: (1, 0), 1: (1, 0), 2: (1, 1), 3: (2, 0)}


def test_a_place_near_which_two_things_stand_out_is_filled_once() -> None:
    sides = np.array([10.0, 20.0])
    grid = np.stack(np.meshgrid(10.0 * np.arange(5), [0.0, 20.0]), axis=-1).reshape(-1, 2)
    missing = (grid == (20.0, 20.0)).all(axis=1)
    at = np.concatenate([grid[~missing], [[18.0, 20.0], [22.5, 20.0], [20.0, 24.0]]])
    scores = np.append(np.full(9, 9.0), [2.0, 2.0, 2.0])
    found = _complete(at, scores, sides)
    assert sorted(map(tuple, found.tolist())) == sorted(map(tuple, grid.tolist()))
