"""The correction of a surface is what the reader of the photo computes with the same settings."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import torch

from mrgs import Scene
from mrgs.data.radiometric import Overrides, read_thermal_photo
from mrgs.errors import ConfigError
from mrgs.marks import Mark, Marks
from mrgs.marks.emissivity import TYPICAL_LAW, CaptureSettings, SurfaceSettings
from mrgs.marks.measure import NO_PHOTO, MarkMeter
from mrgs.marks.regions import Regions
from mrgs.rasterizer.contract import Dilation
from mrgs.runs.baked import BakedModel
from mrgs.scene import THERMAL, Camera, Rendering
from mrgs.scene.radiometry import ObjectParameters, PhotoRecord, Planck
from mrgs_synth.planck import band_radiance, temperature
from tests.helpers.flir import FlirPhoto
from tests.helpers.walls import RANGE, camera_before_wall, render_wall, wall_celsius

REAL_PHOTOS = Path(__file__).parents[3] / "shared/radiometric"
SQUARE = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1.0), (0.0, 0.0, 1.0))
BOX = Mark("B1", "box", SQUARE, (1.0, -5.0, 0.5), emissivity=0.6, reflected_c=-10.0)
SETTINGS = [(0.6, -10.0), (0.85, 60.0), (1.0, 20.0), (0.3, 5.0)]


def capture_of(record: PhotoRecord) -> CaptureSettings:
    assert record.parameters is not None
    assert record.planck is not None
    surface = SurfaceSettings(record.parameters.emissivity, record.parameters.reflected_c)
    return CaptureSettings(surface, record.planck)


def largest_difference(path: Path, emissivity: float, reflected_c: float) -> float:
    """Between the corrected photo and the one that was read with the same settings, °C."""
    photo = read_thermal_photo(path)
    expected = read_thermal_photo(
        path, Overrides(emissivity=emissivity, reflected_c=reflected_c)
    ).temperature_c
    capture = capture_of(photo.facts.record)
    corrected = capture.corrected(
        photo.temperature_c.astype(np.float64), SurfaceSettings(emissivity, reflected_c)
    )
    both = np.isfinite(corrected) & np.isfinite(expected)
    known = np.isfinite(expected).sum(), np.isfinite(photo.temperature_c).sum()
    assert both.sum() > max(500, 0.9 * min(known))
    return float(np.abs(corrected - expected)[both].max())


@pytest.mark.parametrize(("emissivity", "reflected_c"), SETTINGS)
def test_it_is_exact_for_a_written_photo(emissivity, reflected_c, tmp_path):
    parameters = {**FlirPhoto().parameters, "window_transmission": 0.8}
    path = tmp_path / "photo.jpg"
    path.write_bytes(FlirPhoto(parameters=parameters).jpeg())
    assert largest_difference(path, emissivity, reflected_c) < 0.001


@pytest.mark.skipif(not REAL_PHOTOS.is_dir(), reason="no real photos beside the repository")
@pytest.mark.parametrize("path", sorted(REAL_PHOTOS.glob("*.jpg")), ids=lambda path: path.stem[:2])
def test_it_is_exact_for_real_photos(path):
    assert largest_difference(path, 0.7, 5.0) < 0.01


def test_a_region_is_corrected_from_every_side_and_nothing_else():
    capture = CaptureSettings(
        SurfaceSettings(0.95, 20.0), Planck(15000.0, 0.0125, 1400.0, 1.0, -6000.0)
    )
    regions = Regions(Marks((BOX,)), render_wall, RANGE, capture)
    camera = camera_before_wall(-2.0)
    rendering = regions.render(camera)
    before = RANGE.to_celsius(render_wall(camera)[THERMAL].image[..., 0]).numpy()
    after = RANGE.to_celsius(rendering[THERMAL].image[..., 0]).numpy()
    points = camera.unproject_image(rendering.surface_depth(THERMAL)).numpy()
    x, _, z = np.moveaxis(points, -1, 0)
    inside = (x > 0.02) & (x < 0.98) & (z > 0.02) & (z < 0.98)
    outside = ~((x > -0.02) & (x < 1.02) & (z > -0.02) & (z < 1.02))
    assert inside.sum() > 300
    np.testing.assert_array_equal(after[outside], before[outside])
    wanted = capture.corrected(before[inside].astype(np.float64), SurfaceSettings(0.6, -10.0))
    np.testing.assert_allclose(after[inside], wanted, atol=1e-4)
    assert (after[inside] - before[inside]).min() > 5


def test_the_settings_for_most_points_come_first_with_their_shares():
    regions = Regions(Marks((BOX,)), render_wall, RANGE, CaptureSettings())
    inside, outside = [[0.5, 0.0, 0.5], [0.2, 0.0, 0.8]], [[1.5, 0.0, 0.5], [-1.0, 0.0, 0.5]]
    own = SurfaceSettings(0.6, -10.0)
    mostly_outside = regions.shares_at(np.array([*inside, *outside, [0.5, 0.0, 1.5]]))
    assert mostly_outside == [(None, pytest.approx(0.6)), (own, pytest.approx(0.4))]
    assert regions.shares_at(np.array(inside)) == [(own, 1.0), (None, 0.0)]


def test_the_edge_of_a_flat_region_is_straight_where_depths_are_uneven():
    """From the side, a depth that is off shifts a pixel along the wall."""
    generator = torch.Generator().manual_seed(0)

    def render_uneven(camera: Camera) -> Rendering:
        blend = render_wall(camera)[THERMAL]
        share = 0.02 * (2 * torch.rand(blend.depth.shape, generator=generator).double() - 1)
        return Rendering({THERMAL: blend._replace(depth=blend.depth * (1 + share))})

    camera = camera_before_wall(-5.0)
    before = render_wall(camera)[THERMAL].image[..., 0]
    points = camera.unproject_image(render_wall(camera).surface_depth(THERMAL)).numpy()
    x, _, z = np.moveaxis(points, -1, 0)
    after = Regions(Marks((BOX,)), render_uneven, RANGE, CaptureSettings()).render(camera)
    changed = (after[THERMAL].image[..., 0] != before).numpy()
    assert changed[(x > 0.02) & (x < 0.98) & (z > 0.02) & (z < 0.98)].all()
    assert not changed[~((x > -0.02) & (x < 1.02) & (z > -0.02) & (z < 1.02))].any()


def test_what_is_measured_in_a_region_is_corrected():
    capture = CaptureSettings(SurfaceSettings(0.95, 20.0), TYPICAL_LAW)
    spot = Mark("S1", "spot", ((0.5, 0.0, 0.5),), (0.0, -4.0, 0.0), radius=0.03)
    aside = replace(spot, name="S2", points=((1.5, 0.0, 0.5),))
    meter = MarkMeter(render_wall, RANGE, capture=capture)
    box, inner, outer = meter.measure(Marks((BOX, spot, aside)))
    exact = wall_celsius(torch.tensor(spot.points[0])).item()
    wanted = capture.corrected(np.array([exact]), SurfaceSettings(0.6, -10.0))[0]
    assert inner.mean == pytest.approx(wanted, abs=0.01)
    assert outer.mean == pytest.approx(23.5, abs=0.01)
    assert box.mean == pytest.approx(wanted, abs=0.1)


def test_a_region_without_photos_says_so_and_spares_the_others():
    away = camera_before_wall().look_at([0.0, -5.0, 0.0], [-5.0, 0.0, 0.0])
    aside = replace(BOX, name="B2", points=tuple((x - 3.0, y, z) for x, y, z in SQUARE))
    unseen, seen = MarkMeter(render_wall, RANGE, [away]).measure(Marks((BOX, aside)))
    assert (unseen.photos, unseen.problem) == (0, NO_PHOTO)
    assert np.isnan(unseen.mean)
    assert (seen.photos, seen.problem) == (1, "")
    assert np.isfinite(seen.mean)


def test_a_region_that_cannot_be_seen_at_once_spares_the_others():
    about_its_eye = replace(BOX, name="B2", eye=(0.5, -0.05, 0.5))
    good, wide = MarkMeter(render_wall, RANGE).measure(Marks((BOX, about_its_eye)))
    assert np.isfinite(good.mean)
    assert wide.problem.startswith("B2 ")
    assert "too wide" in wide.problem


def test_the_later_of_two_regions_counts():
    capture = CaptureSettings(SurfaceSettings(0.95, 20.0), TYPICAL_LAW)
    over = replace(BOX, name="B2", emissivity=0.95, reflected_c=20.0)
    meter = MarkMeter(render_wall, RANGE, capture=capture)
    first, second = meter.measure(Marks((BOX, over)))
    assert first.mean == second.mean == pytest.approx(21.5, abs=0.02)


def scene_with(*records: PhotoRecord | None) -> Scene:
    cameras = [camera_before_wall(0.1 * number) for number in range(len(records))]
    scene = Scene.from_arrays(cameras, celsius=np.full((len(records), 120, 160), 20.5))
    views = [*scene.eval, *scene.train]
    for view, record in zip(views, records, strict=True):
        view.images[THERMAL].__dict__["record"] = record
    return scene


def test_what_the_photos_were_computed_with():
    law = Planck(15000.0, 0.0125, 1400.0, 1.0, -6000.0)
    record = PhotoRecord(
        "FLIR", taken=datetime(2026, 1, 1), planck=law,
        parameters=ObjectParameters(0.95, 2.0, 20.0, 18.0, 0.4),
    )  # fmt: skip
    assert CaptureSettings.of(scene_with(record, record)) == CaptureSettings(
        SurfaceSettings(0.95, 20.0), law
    )
    assert CaptureSettings.of(scene_with(record, None)).notes == ()
    other = replace(record, parameters=replace(record.parameters, emissivity=0.85))
    mixed = CaptureSettings.of(scene_with(record, other))
    assert mixed.surface.emissivity == pytest.approx(0.9)
    (note,) = [note for note in mixed.notes if "differ" in note]
    assert "median" in note


def test_what_the_photos_do_not_say_is_said():
    capture = CaptureSettings.of(scene_with(None, None))
    assert capture.law == TYPICAL_LAW
    of_emissivity, of_constants = capture.notes
    assert "emissivity" in of_emissivity
    assert "constants" in of_constants
    with pytest.raises(ConfigError, match="reflected temperature"):
        capture.of_mark(replace(BOX, reflected_c=None))
    reading = MarkMeter(render_wall, RANGE).measure(Marks((replace(BOX, reflected_c=None),)))[0]
    assert reading.problem.startswith("B1: ")
    assert "reflected temperature" in reading.problem
    relative = MarkMeter(render_wall, None).measure(Marks((BOX,)))[0]
    assert relative.problem.startswith("B1: without °C")


def test_settings_that_the_user_gave_are_those_of_the_photos():
    """As for photos whose temperatures another program computes with them."""
    given = PhotoRecord("DJI R-JPEG", given={"emissivity": 0.9, "reflected_c": 12.0})
    assert CaptureSettings.of(scene_with(given, given)).surface == SurfaceSettings(0.9, 12.0)
    half_known = PhotoRecord("DJI R-JPEG", given={"emissivity": 0.9})
    assert CaptureSettings.of(scene_with(half_known)).surface == SurfaceSettings(1.0, None)


def test_a_surface_colder_than_its_reflection_has_no_temperature():
    capture = CaptureSettings(SurfaceSettings(0.95, 20.0), TYPICAL_LAW)
    corrected = capture.corrected(np.array([10.0, 60.0]), SurfaceSettings(0.1, 55.0))
    assert np.isnan(corrected[0])
    assert corrected[1] > 60


def test_the_typical_law_is_that_of_black_bodies_near_ten_micrometres():
    """Against Planck's law at 10 µm: the ratio of radiances at 300 K and 290 K."""
    c2 = 14387.77
    exact = np.expm1(c2 / (10 * 290.0)) / np.expm1(c2 / (10 * 300.0))
    found = TYPICAL_LAW.signal(26.85) / TYPICAL_LAW.signal(16.85)
    assert found == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize(
    ("celsius", "emissivity", "reflected_c", "off_c"),
    [
        (20.0, 0.93, 0.0, 0.01),
        (10.0, 0.92, -20.0, 0.01),
        (60.0, 0.95, 20.0, 0.02),
        (40.0, 0.3, 25.0, 0.04),
        (120.0, 0.3, 20.0, 1.3),
    ],
)
def test_the_typical_law_is_near_the_band_of_a_camera(celsius, emissivity, reflected_c, off_c):
    """A surface as a camera of 7.5 to 13 µm reads it, whose file holds no calibration."""
    own, reflected = band_radiance(np.array([celsius, reflected_c]))
    reading = temperature(np.array(emissivity * own + (1 - emissivity) * reflected))
    found = CaptureSettings().corrected(reading, SurfaceSettings(emissivity, reflected_c))
    assert found == pytest.approx(celsius, abs=off_c)


def test_splats_of_a_region_are_corrected():
    points = torch.tensor([[0.5, 0.01, 0.5], [2.0, 0.0, 0.5]])
    normalised = RANGE.from_celsius(wall_celsius(points))
    opaque = {THERMAL: torch.ones(2)}
    baked = BakedModel(
        points,
        torch.eye(4)[:2],
        torch.ones(2, 3),
        opaque,
        {},
        {},
        normalised,
        RANGE,
        dilation=Dilation(),
    )
    capture = CaptureSettings(SurfaceSettings(0.95, 20.0), TYPICAL_LAW)
    corrected = Regions(Marks((BOX,)), render_wall, RANGE, capture).of_splats(baked)
    wanted = capture.corrected(np.array([21.5]), SurfaceSettings(0.6, -10.0))[0]
    assert RANGE.to_celsius(corrected.temperatures).tolist() == pytest.approx(
        [wanted, 24.5], abs=1e-3
    )


def test_points_of_a_region_are_corrected_by_the_later_of_two_marks():
    capture = CaptureSettings(SurfaceSettings(0.95, 20.0), TYPICAL_LAW)
    right = ((0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1.0), (0.5, 0.0, 1.0))
    over = replace(BOX, name="B2", points=right, emissivity=0.1, reflected_c=55.0)
    points = np.array([[0.2, 0.0, 0.5], [0.8, 0.0, 0.5], [1.2, 0.0, 0.5]])
    celsius = np.array([20.9, 22.1, 22.9], np.float32)
    found = Regions(Marks((BOX, over)), render_wall, RANGE, capture).corrected_at(points, celsius)
    wanted = capture.corrected(np.array([20.9]), SurfaceSettings(0.6, -10.0))[0]
    assert found.tolist() == pytest.approx([wanted, 22.1, 22.9])  # none is 22.1 °C so
