"""Two dates of one wall, whose temperatures and coordinates are known."""

from __future__ import annotations

import csv
import json
import math
import sys
import tracemalloc
from copy import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mrgs.errors import ConfigError, RunError
from mrgs.field import FieldConfig, RadianceField
from mrgs.field.spherical_harmonics import C0
from mrgs.marks.mark import Mark, Marks
from mrgs.marks.run_marks import open_marks
from mrgs.marks.uncertainty import InputQuantity, Uncertainty
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model
from mrgs.report.changes import (
    Differences,
    Surface,
    _Comparison,
    _Date,
    _same_camera,
    _thinned,
    diff_runs,
    kind_of,
    moved_mark,
    outline_of,
)
from mrgs.run_files.folder import RunFolder
from mrgs.runs.open import Run, load_run
from mrgs.scene import (
    RGB,
    THERMAL,
    Camera,
    Gaussians,
    Pixels,
    PointCloud,
    PosedImage,
    Scene,
    TemperatureRange,
    View,
    WorldFrame,
)
from mrgs.scene.radiometry import PhotoRecord

CELSIUS = TemperatureRange(0.0, 30.0)
WIDTH, HEIGHT, STEP, TILE = 4.0, 2.4, 0.05, 0.2
BACKGROUND_C, WEATHER_K, HOT_K = 12.0, 3.0, 6.0
BEFORE, BOTH, AFTER = (-1.0, 1.2), (0.2, 1.6), (1.1, 1.0)
"""Middles of round hot patches: x and z, metres; one is gone, one stays, one is new."""

RADIUS = 0.3
SCALE, TURN, SHIFT = 1.7, Rotation.from_euler("zyx", (70, 20, -35), degrees=True), (3.0, -2.0, 1.0)
"""The second run's coordinates."""


def wall(patches: tuple[tuple[float, float], ...], level_c: float, seed: int) -> Model:
    """An upright wall y = 0 with random tiles."""
    u, v = np.meshgrid(np.arange(-WIDTH / 2, WIDTH / 2, STEP), np.arange(0, HEIGHT, STEP))
    u, v = u.ravel() + STEP / 2, v.ravel() + STEP / 2
    rng = np.random.default_rng(seed)
    tiles = rng.uniform(0.1, 0.9, (40, 40, 3))
    colors = tiles[(u / TILE + 20).astype(int), (v / TILE).astype(int)]
    celsius = np.full(len(u), level_c)
    for x, z in patches:
        celsius[np.hypot(u - x, v - z) < RADIUS] += HOT_K
    count, field = len(u), RadianceField(FieldConfig(residuals=False))
    means = torch.from_numpy(np.stack([u, np.zeros_like(u), v], axis=1)).float()
    thermal = torch.from_numpy(CELSIUS.from_celsius(celsius)).float()
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        log_scales=torch.tensor([0.9 * STEP, 0.1 * STEP, 0.9 * STEP]).log().repeat(count, 1),
        opacity_logits={each: torch.full((count, 1), 6.0) for each in (RGB, THERMAL)},
        sh_dc={
            RGB: torch.from_numpy((colors - 0.5) / C0).float()[:, None],
            THERMAL: ((thermal - 0.5) / C0)[:, None, None],
        },
        sh_rest={RGB: torch.zeros(count, 15, 3), THERMAL: torch.zeros(count, 0, 1)},
        embedding=field.initial_embedding(means),
    )
    return Model(gaussians, field, None, sh_degree=0, dilation=Dilation())


def moved(model: Model, cameras: list[Camera]) -> tuple[Model, list[Camera]]:
    """The same in the second run's coordinates."""
    turn = torch.from_numpy(TURN.as_matrix()).float()
    x, y, z, w = TURN.as_quat()
    g = model.gaussians
    gaussians = replace(
        g,
        means=SCALE * g.means @ turn.T + torch.tensor(SHIFT),
        quats=torch.tensor([w, x, y, z]).float().repeat(len(g), 1),
        log_scales=g.log_scales + math.log(SCALE),
    )
    found = []
    for camera in cameras:
        viewmat = torch.eye(4).double()
        viewmat[:3, :3] = camera.viewmat[:3, :3] @ turn.double().T
        viewmat[:3, 3] = (
            SCALE * camera.viewmat[:3, 3] - viewmat[:3, :3] @ torch.tensor(SHIFT).double()
        )
        found.append(Camera(camera.K, viewmat, camera.width, camera.height))
    return replace(model, gaussians=gaussians), found


def photographed(run: Run, cameras: list[Camera], world: WorldFrame) -> Scene:
    """The scene of photos that show what the run does."""

    def image(camera: Camera, modality) -> PosedImage:
        pixels = Pixels(run.render(camera)[modality].image.clamp(0, 1))
        return PosedImage(camera, lambda: pixels)

    views = tuple(
        View(f"v{number}", {each: image(camera, each) for each in (RGB, THERMAL)})
        for number, camera in enumerate(cameras)
    )
    means = run.model.gaussians.means
    points = PointCloud(means, torch.full_like(means, 0.5))
    return Scene("wall", views, (), points, CELSIUS, world=world)


def date(trained: Path, path: Path, model: Model, cameras: list[Camera], metric: bool):
    opened = load_run(trained)
    facts = opened.facts._replace(temperature=CELSIUS)
    path.mkdir()
    run = replace(opened, model=model, facts=facts, folder=RunFolder(path))
    return run, photographed(run, cameras, WorldFrame(metric))


def cameras(shift: float) -> list[Camera]:
    lens = Camera.from_fov(200, 150, 65)
    return [
        lens.look_at((x + shift, -2.6 + 0.1 * abs(x), 1.3), (0.4 * x, 0.0, 1.2))
        for x in np.linspace(-1.5, 1.5, 5)
    ]


@pytest.fixture(scope="module")
def first(trained: Path, tmp_path_factory):
    model = wall((BEFORE, BOTH), BACKGROUND_C, 0)
    return date(trained, tmp_path_factory.mktemp("a") / "run", model, cameras(0.0), True)


@pytest.fixture(scope="module")
def second(trained: Path, tmp_path_factory):
    model, places = moved(wall((BOTH, AFTER), BACKGROUND_C + WEATHER_K, 0), cameras(0.2))
    return date(trained, tmp_path_factory.mktemp("b") / "run", model, places, False)


@pytest.fixture(scope="module")
def found(first, second) -> Differences:
    marks = open_marks(*first)
    spots = tuple(
        Mark(name, "spot", ((x, 0.0, z),), (x, -2.5, z), radius=0.1)
        for name, (x, z) in {"Gone": BEFORE, "Same": BOTH, "Wall": (-0.3, 0.4)}.items()
    )
    marks.store.edit(lambda _: Marks(spots))
    return diff_runs(first[0], second[0], relative=True, scenes=(first[1], second[1]))


def test_the_second_run_is_aligned(found):
    r = found.registration
    assert r.scale == pytest.approx(SCALE, rel=3e-3)
    points = np.array([[-1.5, 0, 0.5], [1.5, 0, 2.0], [0, 0, 1]])
    exact = SCALE * points @ TURN.as_matrix().T + SHIFT
    np.testing.assert_allclose(r(points), exact, atol=0.02 * SCALE)
    assert r.overlap > 0.8


def test_what_is_new_and_what_is_gone_is_found_and_nothing_else(found):
    assert found.common == pytest.approx(WEATHER_K, abs=0.1)
    assert sorted(each.kind for each in found.changes) == ["gone", "new"]
    for change in found.changes:
        exact, place = (-HOT_K, BEFORE) if change.kind == "gone" else (HOT_K, AFTER)
        assert change.difference == pytest.approx(exact, rel=0.15)  # its edge is blurred
        middle = np.mean(change.mark.points, axis=0)
        np.testing.assert_allclose(middle[[0, 2]], place, atol=0.08)
        assert change.area == pytest.approx(math.pi * RADIUS**2, rel=0.3)


def test_marks_are_measured_on_both_dates(found):
    marks = {each.mark.name: each for each in found.marks}
    assert marks["Gone"].difference == pytest.approx(-HOT_K, abs=0.3)
    for name in ("Same", "Wall"):
        assert abs(marks[name].difference) < max(marks[name].uncertainty, 0.1)
    assert marks["Wall"].after == pytest.approx(BACKGROUND_C + WEATHER_K, abs=0.1)


def test_files(found, tmp_path):
    paths = {path.name: path for path in found.write(tmp_path, "de")}
    with paths["changes.csv"].open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["D1", "D2", "Gone", "Same", "Wall"]
    features = json.loads(paths["changes.geojson"].read_text())["features"]
    assert [each["geometry"]["type"] for each in features] == 2 * ["Polygon"] + 3 * ["Point"]
    page = paths["diff.html"].read_text()
    assert "3,0 K" in page
    assert "Same" in page
    assert "difference.png" in paths


@pytest.mark.parametrize(
    ("language", "said"),
    [("en", "One place has changed by"), ("de", "Eine Stelle hat"), ("fr", "Un endroit a changé")],
)
def test_one_change_is_said_in_the_singular(found, tmp_path, language, said):
    page = replace(found, changes=found.changes[:1]).write(tmp_path, language)[0].read_text()
    assert f'<p class="lead">{said}' in page


def of_scene(found: Differences, **changes) -> Differences:
    """The same with another scene of the first date."""
    date = copy(found.dates[0])
    date.scene = replace(date.scene, **changes)
    return replace(found, dates=(date, found.dates[1]))


def test_without_metres_there_is_no_geotiff(found, tmp_path):
    names = {path.name for path in of_scene(found, world=WorldFrame()).write(tmp_path)}
    assert "difference.png" in names
    assert "difference.tif" not in names


def test_what_is_seen_from_all_sides_has_no_map(found, tmp_path, monkeypatch):
    monkeypatch.setattr("mrgs.report.changes.draw_temperature_map", lambda *_: pytest.fail("drawn"))
    lens = Camera.from_fov(200, 150, 65)
    around = (lens.look_at((2 * x, 2 * y, 1.2), (0, 0, 1.2)) for x, y in ((1, 1), (-1, -1)))
    views = (
        replace(view, images={m: replace(i, camera=camera) for m, i in view.images.items()})
        for view, camera in zip(found.dates[0].scene.train, around, strict=False)
    )
    names = {path.name for path in of_scene(found, train=tuple(views)).write(tmp_path)}
    assert names == {"diff.html", "changes.csv", "changes.geojson"}


def test_the_common_change_stays_unless_it_is_to_be_subtracted(first, second, found):
    plain = diff_runs(first[0], second[0], scenes=(first[1], second[1]))
    assert len(plain.changes) == len(found.changes)
    for one, other in zip(plain.changes, found.changes, strict=True):
        assert one.difference == pytest.approx(other.difference + found.common)


def test_a_change_has_an_uncertainty_though_no_photo_shows_enough_of_it(found, monkeypatch):
    """The whole wall, of which each photo shows at most four fifths; and where no photo counts, by
    its places."""
    comparison = _Comparison(found.dates, found.registration, found.surface, True)
    wall = np.ones(len(found.surface.points), bool)
    changes = [comparison.of_change(wall, 1.0)[1]]
    for least_share in (0.95, 1.5):
        monkeypatch.setattr("mrgs.marks.photo_readings.LEAST_SHARE", least_share)
        changes.append(comparison.of_change(wall, 1.0)[1])
    usual, by_pieces, by_places = changes
    assert usual.difference == by_pieces.difference == by_places.difference
    assert 0.4 < by_pieces.uncertainty / usual.uncertainty < 2.5
    around = np.sqrt(np.mean(np.square(found.surface.around)))
    assert by_places.uncertainty == pytest.approx(around, rel=0.02)


def test_places_are_as_far_apart_as_pixels_of_the_coarser_date(found, monkeypatch):
    sizes = iter((0.02, 0.2))
    monkeypatch.setattr("mrgs.report.changes.survey_pixel", lambda maps: next(sizes))
    surface = Surface.of(found.dates, found.registration)
    assert surface.pixel == pytest.approx(0.2 / SCALE, rel=0.01)


def test_a_place_that_two_photos_show_is_not_compared(found):
    date = found.dates[0]
    points = np.concatenate([each.points() for each in date.meter.survey])[::50]
    photos = np.zeros(len(points), int)
    for each in date.meter.survey:
        photos[each.shown(points.astype(np.float32)).rows] += 1
    compared = np.isfinite(date.celsius(points)[0])
    assert (photos == 2).any()
    assert compared[photos < 3].mean() < 0.05  # on outlines photos show a place, but no temperature
    assert compared[photos > 3].mean() > 0.9


def test_changes_have_names_of_their_own(first, second, found):
    store = open_marks(*first).store
    store.edit(
        lambda marks: replace(marks, marks=(*marks.marks, replace(marks.marks[0], name="D1")))
    )
    try:
        again = diff_runs(first[0], second[0], scenes=(first[1], second[1]))
    finally:
        store.edit(lambda marks: replace(marks, marks=marks.marks[:-1]))
    assert [each.mark.name for each in again.changes] == ["D2", "D3"]


@pytest.mark.parametrize(
    ("language", "said"),
    [
        ("en", "not used: Pane."),
        pytest.param("de", "angewendet: Pane.", marks=pytest.mark.slow),
        pytest.param("fr", "appliqués : Pane.", marks=pytest.mark.slow),
    ],
)
def test_what_only_the_second_runs_marks_state_is_said(
    first, second, found, tmp_path, language, said
):
    corners = ((-0.5, 0.0, 0.2), (0.5, 0.0, 0.2), (0.5, 0.0, 0.8), (-0.5, 0.0, 0.8))
    pane = Mark("Pane", "box", corners, (0.0, -2.0, 0.5), emissivity=0.6)
    store = open_marks(*second).store
    store.edit(lambda _: Marks((moved_mark(found.registration, pane),)))
    try:
        again = diff_runs(first[0], second[0], scenes=(first[1], second[1]))
    finally:
        store.edit(lambda _: Marks())
    assert again.ignored == ("Pane",)
    assert not found.ignored
    assert said in again.write(tmp_path, language)[0].read_text()


def test_what_is_too_narrow_is_not_measured(found):
    coarse = replace(found.surface, pixel=10.0)
    comparison = _Comparison(found.dates, found.registration, coarse, True)
    assert comparison.of_change(np.ones(len(coarse.points), bool), 1.0) is None


def test_one_run_has_no_two_dates(first):
    with pytest.raises(ConfigError, match="twice"):
        diff_runs(first[0], first[0])


def test_a_least_change_is_above_0(first, second):
    with pytest.raises(ConfigError) as error:
        diff_runs(first[0], second[0], least_k=0.0)
    assert error.value.options == ("least_k",)


def test_without_celsius_there_is_no_difference(first, second):
    normalised = replace(second[0], facts=second[0].facts._replace(temperature=None))
    with pytest.raises(RunError, match="no temperatures in °C") as error:
        diff_runs(first[0], normalised)
    assert str(second[0].folder.path) in str(error.value)


def test_runs_show_the_same_modalities(first, second):
    views = tuple(View(view.name, {THERMAL: view.images[THERMAL]}) for view in second[1].train)
    with pytest.raises(RunError, match="modalities"):
        diff_runs(first[0], second[0], scenes=(first[1], replace(second[1], train=views)))


def test_another_object_is_refused(first, trained, tmp_path):
    run, scene = date(trained, tmp_path / "other", wall((), 12.0, 9), cameras(0.0), True)
    with pytest.raises(RunError, match="cannot be aligned"):
        diff_runs(first[0], run, scenes=(first[1], scene))


def test_metres_that_differ_are_refused(first, second):
    metric = replace(second[1], world=WorldFrame(True))
    with pytest.raises(RunError, match="metre"):
        diff_runs(first[0], second[0], scenes=(first[1], metric))


def test_surfaces_that_do_not_coincide_are_refused(first, second, monkeypatch):
    monkeypatch.setattr("mrgs.maps.registration.LEAST_OVERLAP", 1.1)
    with pytest.raises(RunError, match="coincide"):
        diff_runs(first[0], second[0], scenes=(first[1], second[1]))


def test_the_thermal_photos_show_the_same_surface(first, second, monkeypatch):
    monkeypatch.setattr("mrgs.report.changes.FEWEST_PLACES", 10**9)
    with pytest.raises(RunError, match="in common"):
        diff_runs(first[0], second[0], scenes=(first[1], second[1]))


@pytest.mark.parametrize(
    ("same_camera", "kept", "constants"), [(True, ["camera"], 1), (False, [], 0)]
)
def test_the_errors_of_each_date(same_camera, kept, constants):
    names = "camera", "emissivity", "reflected", "distance"
    stated = Uncertainty(0.1, 0.1, 0.1, {InputQuantity(name): 1.0 for name in names})
    date = object.__new__(_Date)
    date.number, date.same_camera = 2, same_camera
    date.__dict__["constant_c"] = 0.5
    shared = date.dated(stated).shared
    assert [each.name for each in shared if each in stated.shared] == [*kept, "emissivity"]
    assert sum(each.name == "constant" for each in shared) == constants


def test_two_reflected_temperatures_of_one_date_both_count():
    date = object.__new__(_Date)
    date.number, date.same_camera = 2, True
    date.__dict__["constant_c"] = 0.0
    two = {InputQuantity("reflected", 20.0): 0.3, InputQuantity("reflected", 5.0): 0.4}
    assert date.dated(Uncertainty(0.0, 0.0, 0.0, two)).total == pytest.approx(0.5)


def test_without_a_known_accuracy_the_drift_counts():
    date = object.__new__(_Date)
    date.number, date.same_camera = 1, False
    date.__dict__["constant_c"] = 0.5
    assert [*date.dated(Uncertainty(0.1, 0.1, 0.1)).shared.values()] == [0.5]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [(["7"], ["7"], True), (["7"], ["8"], False), ([""], [""], False), (["7", "8"], ["7"], False)],
)
def test_a_camera_is_the_same_by_its_serial_number(one, other, same):
    scenes = [
        SimpleNamespace(records=[PhotoRecord(serial=each) for each in serials])
        for serials in (one, other)
    ]
    assert _same_camera(*scenes) == same


def test_pycolmap_is_of_an_extra(first, second, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ConfigError, match="sfm"):
        diff_runs(first[0], second[0], scenes=(first[1], second[1]))


def test_a_mark_moves_with_its_eye_and_radius(found):
    mark = Mark("S", "spot", ((1.0, 0.0, 1.0),), (0.0, -2.0, 1.0), radius=0.1)
    there = moved_mark(found.registration, mark)
    assert there.radius == pytest.approx(0.1 * SCALE, rel=0.01)
    away = np.linalg.norm(np.array(there.points[0]) - there.eye)
    assert away == pytest.approx(SCALE * math.sqrt(5), rel=0.01)


PART = np.repeat([True, False], [10, 30])
BESIDE = np.repeat([0.0, 1.0, 0.0], [10, 5, 25])
"""Five of the surrounding places."""


@pytest.mark.parametrize(
    ("before", "after", "kind"),
    [
        (0 * PART, 5 * PART, "new"),
        (0 * PART, -5 * PART, "new"),
        (5 * PART, 0 * PART, "gone"),
        (5 * BESIDE, 5 * PART + 5 * BESIDE, "grown"),
        (-5 * PART - 5 * BESIDE, -5 * BESIDE, "shrunk"),
        (5 * PART, 8 * PART, "warmer"),
        (5 * PART, 3 * PART, "colder"),
        (-5 * PART, -3 * PART, "warmer"),
    ],
)
def test_kinds_of_changes(before, after, kind):
    assert kind_of(before.astype(float), after + 2.0, PART, ~PART) == kind


def test_without_surroundings_a_change_is_warmer_or_colder():
    nothing = np.zeros(40, bool)
    assert kind_of(np.zeros(40), 2.0 * PART, PART, nothing) == "warmer"


def surface(before: np.ndarray, after: np.ndarray) -> Surface:
    rows, columns = np.indices(before.shape)
    points = np.stack([columns.ravel(), rows.ravel(), 0 * rows.ravel()], axis=1).astype(float)
    pairs = KDTree(points).query_pairs(2.0, output_type="ndarray")
    nothing = np.zeros(before.size)
    return Surface(points, 1.0, before.ravel(), after.ravel(), nothing, pairs)


@given(seed=st.integers(0, 1000), row=st.integers(-1, 1), column=st.integers(-1, 1))
def test_what_is_only_displaced_has_not_changed(seed, row, column):
    before = np.random.default_rng(seed).normal(0, 5, (12, 14))
    after = np.roll(before, (row, column), axis=(0, 1)) + 2.5
    shown = surface(before[2:-2, 2:-2], after[2:-2, 2:-2])
    inner = np.zeros((8, 10), bool)
    inner[2:-2, 2:-2] = True
    off = shown.certain[inner.ravel()]
    assert np.abs(off).max() <= abs(shown.common - 2.5) + 1e-9


def map_of(*size: int, seed: int = 0, wide: float = 40.0) -> SimpleNamespace:
    """As a depth map: random points of a wall, which are made when they are asked for."""
    return SimpleNamespace(
        points=lambda: np.random.default_rng(seed).uniform(0, (wide, wide, 0.5), (*size, 3))
    )


def test_places_are_the_means_over_all_maps():
    maps = [map_of(3_000, seed=seed) for seed in range(4)]
    every = np.concatenate([each.points() for each in maps])
    (apart, pixel), (at_once, _) = (
        _thinned(some, 1.0) for some in (maps, [SimpleNamespace(points=lambda: every)])
    )
    assert pixel == 1.0
    assert len(apart) == 1600
    np.testing.assert_allclose(apart, at_once)


def test_many_maps_take_the_memory_of_one():
    maps = [map_of(20_000, seed=seed) for seed in range(40)]
    tracemalloc.start()
    _thinned(maps, 1.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < sum(each.points().nbytes for each in maps)


def test_places_of_a_large_plant_stay_as_small_as_pixels():
    points, pixel = _thinned([map_of(800_000, wide=1000.0)], 1.0)
    assert pixel == 1.0
    assert len(points) > 500_000


def test_far_points_have_larger_places():
    points, pixel = _thinned([map_of(100), map_of(100, wide=1e12)], 1e-3)
    assert 50 < len(points) <= 200
    assert pixel > 1e-3


def test_even_patches_count_with_their_whole_change():
    before, after = np.zeros((20, 20)), np.zeros((20, 20))
    after[5:12, 6:13], before[14:19, 2:7] = 4.0, 3.0
    (new,), (gone,) = (
        [each for each in surface(before, after).parts(1.0) if each[place]]
        for place in (8 * 20 + 9, 16 * 20 + 4)
    )
    assert new.sum() == 49
    assert gone.sum() == 25


def test_a_large_round_change_has_an_outline_of_not_too_many_corners():
    around = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    ring = 50 * np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
    filled = np.concatenate([share * ring for share in np.linspace(0.02, 1, 50)])
    corners, area, width = outline_of(filled, 1.0)
    assert 50 <= len(corners) <= 100
    assert area == pytest.approx(np.pi * 50**2, rel=0.05)
    assert width == pytest.approx(101, abs=1)


@pytest.mark.parametrize("reach", [2.0, 4.0])
def test_surroundings_are_what_is_near_and_unchanged(reach):
    before, after = np.zeros((30, 30)), np.zeros((30, 30))
    after[10:20, 10:20] = 3.0
    after[22, 15] = 2.0
    shown = surface(before, after)
    shown = replace(shown, pixel=reach / 4)
    part = (after == 3.0).ravel()
    ring = shown.surroundings(part, 1.0).reshape(30, 30)
    assert not ring[10:20, 10:20].any()
    assert not ring[22, 15]
    assert ring[15, 20]
    assert ring[15, 22] == (reach == 4.0)
    assert not ring[15, 25]
