from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data import load_scene
from mrgs.data.earth import enu
from mrgs.data.radiometric.exif import read_exif
from mrgs.errors import ConfigError
from mrgs.scene import THERMAL
from mrgs_synth.solar_plant import PlantOptions, synthesize_mornings, synthesize_plant
from mrgs_synth.solar_plant.cast import photograph, surfaces_of
from mrgs_synth.solar_plant.flight import ORIGIN, survey
from mrgs_synth.solar_plant.layout import PITCH_M, Plant, drawn_plant

SMALL = PlantOptions(
    rows=2, modules=6, overlap=0.4, gps_noise_m=0.5, eval_views=2, width=64, height=48, seed=5
)


@pytest.fixture(scope="module")
def small_plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plant")
    synthesize_plant(folder, SMALL)
    return folder


@pytest.fixture(scope="module")
def plant() -> Plant:
    return drawn_plant(2, 8, 24.0, np.random.default_rng(5))


def test_a_plant_is_a_scene_in_metres_with_a_place_on_earth(small_plant: Path) -> None:
    scene = load_scene(small_plant)
    assert scene.world.is_georeferenced
    assert len(scene.eval) == 2
    assert len(scene.points.positions) > 30 * len(scene.train)
    assert scene.temperature is not None
    first = scene.train[0].images[THERMAL].load().values
    assert len(first.unique()) > 256  # 16 bits


def test_the_same_options_give_the_same_files(small_plant: Path, tmp_path: Path) -> None:
    synthesize_plant(tmp_path, SMALL)
    for path in (file for file in small_plant.rglob("*") if file.is_file()):
        assert (tmp_path / path.relative_to(small_plant)).read_bytes() == path.read_bytes()


def test_the_thermal_photos_show_the_exact_temperatures(small_plant: Path) -> None:
    scene = load_scene(small_plant)
    assert scene.temperature is not None
    for view in scene.eval:
        exact = np.asarray(Image.open(small_plant / f"truth/temperature/{view.name}.tiff"))
        shown = scene.temperature.to_celsius(view.images[THERMAL].load().values[..., 0]).numpy()
        assert abs(np.median(shown - exact)) < 0.1
        assert np.corrcoef(shown.ravel(), exact.ravel())[0, 1] > 0.9


def test_photos_carry_noisy_positions(small_plant: Path) -> None:
    scene = load_scene(small_plant)
    away = []
    for view in scene.views:
        gps = read_exif((small_plant / f"images/{view.name}.jpg").read_bytes()).gps
        assert gps is not None
        origin = type(gps)(*ORIGIN)
        away.append(enu([gps], origin)[0] - view.camera.position.numpy())
    assert 0.2 < np.std(away) < 0.8
    median_m = float(np.median(np.linalg.norm(away, axis=1)))
    assert scene.world.residual_m == pytest.approx(median_m, abs=2e-3)


def test_rows_follow_the_ground(plant: Plant) -> None:
    tables = plant.tables
    clearance = tables.corner[:, 2] - plant.ground.height_at(*tables.corner[:, :2].T)
    assert (clearance > 0.3).all()
    assert np.ptp(tables.corner[:, 2]) > 0.05
    south = [tables.corner[tables.row == row, 1].mean() for row in (0, 1)]
    assert south[1] - south[0] == pytest.approx(PITCH_M)


def test_a_defect_is_where_its_truth_says(plant: Plant) -> None:
    """A camera straight above sees its temperature at its place, and its depth."""
    surfaces = surfaces_of(plant)
    flight = survey(plant.low, plant.high, 0.6, (320, 240), 0, 0.0, np.random.default_rng([5, 3]))
    module = next(each for each in plant.defects if each.kind == "module")
    point = np.array([module.position_m])
    camera = min(
        flight.cameras.values(),
        key=lambda each: float(np.linalg.norm(each.position.numpy()[:2] - point[0, :2])),
    )
    pixels, z = camera.project(torch.from_numpy(point))
    column, row = pixels[0].long().tolist()
    photo = photograph(surfaces, camera)
    assert photo.depth_m[row, column] == pytest.approx(float(z), abs=0.05)
    table = np.flatnonzero(plant.tables.row == module.row)[module.table]
    sound = np.median(plant.tables.cell_c[table])
    around = photo.exact_c[row - 2 : row + 3, column - 2 : column + 3]
    assert np.median(around) - sound == pytest.approx(module.delta_c, abs=1.2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": 0}, "row"),
        ({"overlap": 1.0}, r"0\.95"),
        ({"gps_noise_m": -1.0}, "0 m"),
        ({"width": 17}, "even sizes"),
    ],
)
def test_impossible_plants_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PlantOptions(**change)


def test_defects_are_listed(small_plant: Path) -> None:
    listed = json.loads((small_plant / "truth/defects.json").read_text())["defects"]
    assert {each["kind"] for each in listed} == {"cell", "substring", "module"}
    assert all(each["delta_c"] > 2 and min(each["size_m"]) > 0.1 for each in listed)


def test_two_mornings_of_a_plant(tmp_path: Path) -> None:
    found = synthesize_mornings(tmp_path / "a", tmp_path / "b", SMALL)
    first, second = load_scene(tmp_path / "a"), load_scene(tmp_path / "b")
    facts = json.loads((tmp_path / "a/truth/changes.json").read_text())
    assert {each.kind for each in found} >= {"new", "gone", "same"}
    assert [each["kind"] for each in facts["changes"]] == [each.kind for each in found]
    [placed] = facts["second_from_first"]
    assert placed["scale"] == 1.0
    assert 0 < np.linalg.norm(placed["shift"]) < 5
    assert len(first.train) == len(second.train)
    change = next(each for each in found if each.kind == "new" and each.before.radius_m > 0.8)
    seen = []
    for view in first.train:
        pixel, _ = view.camera.project(torch.tensor([change.center], dtype=torch.float64))
        if view.camera.contains(pixel)[0]:
            column, row = pixel[0].long().tolist()
            before, after = (
                np.asarray(Image.open(tmp_path / f"a/truth/{kind}/{view.name}.tiff"))
                for kind in ("temperature", "after")
            )
            seen.append(((after - before)[row, column], np.median(after - before)))
    beside = np.median([at - common for at, common in seen])
    assert beside == pytest.approx(change.after.kelvin, abs=1.5)
