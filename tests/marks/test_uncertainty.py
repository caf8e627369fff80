"""Uncertainties of marks on a wall, whose photos differ from the model by known amounts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mrgs.data.radiometric.measurement import Measurement
from mrgs.marks import Mark, Marks
from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.measure import MarkMeter
from mrgs.marks.photo_readings import (
    FEW_PHOTOS,
    OF_MARK,
    OF_POINT,
    ONE_PHOTO,
    SHIFT_PX,
    PhotoReadings,
    SightingSums,
)
from mrgs.marks.tables import mark_text
from mrgs.marks.uncertainty import Budget, InputQuantity, Uncertainty, UncertaintyMeter
from mrgs.scene import THERMAL, Pixels, PosedImage, View, WorldFrame, ideal_cameras
from mrgs.scene.air import USUAL_AIR
from mrgs.scene.radiometry import ObjectParameters, PhotoRecord, Planck
from mrgs.survey import Survey
from tests.helpers.drifting import drifting_scene
from tests.helpers.walls import RANGE, camera_before_wall, render_wall

EYE = (0.0, -5.0, 0.5)
BOX = Mark("B1", "box", ((0.0, 0.0, 0.0), (1, 0.0, 0.0), (1, 0.0, 1.0), (0.0, 0.0, 1.0)), EYE)
SHIFTS_C = (-0.1, 0.0, 0.2)
CAPTURE = CaptureSettings(SurfaceSettings(0.95, 20.0))
SETTINGS = ObjectParameters(0.95, 8.0, 20.0, 10.0, 0.5)


def photo_of_wall(number: int, shift_c: float) -> View:
    camera = camera_before_wall(number - 1.0)
    values = render_wall(camera)[THERMAL].image.float() + shift_c / RANGE.span_c
    return View(f"v{number}", {THERMAL: PosedImage(camera, lambda: Pixels(values))})


def channels(reading: float) -> np.ndarray:
    """What one photo reads of one place, and nothing about its surroundings."""
    return np.array([[reading, 11.5, 0, 0, 0, 0, 0]], np.float32)


def meter_of(budget: Budget | None = None, views: list[View] | None = None) -> MarkMeter:
    if views is None:
        views = [photo_of_wall(number, shift) for number, shift in enumerate(SHIFTS_C)]
    cameras = [view.camera for view in views]
    witnesses = PhotoReadings(render_wall, ideal_cameras, views, RANGE)
    capture = CaptureSettings() if budget is None else budget.capture
    uncertainty = UncertaintyMeter(witnesses, budget or Budget())
    return MarkMeter(render_wall, RANGE, cameras, capture, uncertainty)


def of_place(
    budget: Budget, of_photos: Uncertainty, celsius: float, surface: SurfaceSettings | None = None
) -> Uncertainty:
    """Uncertainty of a temperature of a surface, by default one with the settings of the photos."""
    surfaces = [] if surface is None else [(surface, np.array([True]))]
    return budget.of_mean(of_photos, np.array([celsius]), surfaces)


def test_what_photos_disagree_by():
    even = (-0.3, 0.0, 0.3)  # their mean is that of the model
    views = [photo_of_wall(number, shift) for number, shift in enumerate(even)]
    found = meter_of(views=views).read(BOX).uncertainty
    assert found.photos == pytest.approx(2 * OF_MARK.scatter * np.std(even), rel=0.01)
    assert found.model == pytest.approx(0.0, abs=0.1)
    assert found.detail == pytest.approx(0.0, abs=1e-3)  # an even slope
    assert found.total == pytest.approx(math.hypot(found.photos, found.model))
    assert found.known.keys() == {"photos", "model", "detail"}


def test_one_photo_alone_says_as_much_as_the_place_is_even():
    found = meter_of(views=[photo_of_wall(0, 0.0)]).read(BOX).uncertainty
    pixel_m = 5 / camera_before_wall().K[0, 0].item()
    change = SHIFT_PX * pixel_m * (5 / 2) ** 0.5  # 2 and 1 K per metre across and down
    # The photo sees it at an angle, and in larger pixels than it is measured in.
    assert 1 < found.photos / (OF_MARK.scatter * ONE_PHOTO * change) < 2


def test_near_photos_weigh_more():
    sums = SightingSums(1, 0.0)
    for reading, z in ((10.0, 1.0), (12.0, 2.0), (12.0, 2.0)):
        sums.add(np.array([0]), channels(reading), np.array([z], np.float32))
    mean, spread = (10 + 2 * 12 / 4) / 1.5, np.sqrt((4 / 9 + 2 * (4 / 3) ** 2 / 4) / 1.5)
    parts = sums.parts(OF_MARK, np.array([mean + 1]))
    # In effect two photos: (1 + 1/4 + 1/4)² / (1 + 1/16 + 1/16).
    assert parts.photos[0] == pytest.approx(3 * OF_MARK.scatter * spread, rel=1e-3)
    assert parts.model[0] == pytest.approx(OF_MARK.deviation, rel=1e-3)


def test_a_value_that_differs_from_what_the_photos_read_is_doubtful():
    sums = SightingSums(2, 0.2)
    for reading in (10.0, 12.0):
        sums.add(np.array([0]), channels(reading), np.ones(1, np.float32))
    parts = sums.parts(OF_MARK, np.array([11.5, 3.0]))
    assert parts.photos[0] == pytest.approx(math.hypot(3 * OF_MARK.scatter, 0.2), rel=1e-3)
    assert parts.model[0] == pytest.approx(0.5 * OF_MARK.deviation)
    assert np.isnan(parts.total[1])
    assert sums.parts(OF_POINT).model[0] == 0.0


def test_a_narrow_peak_is_doubtful_and_a_slope_is_not():
    sums = SightingSums(2, 0.0)
    slope, peak = [20, 20, 2, -2, 1, -1, 0], [20, 20, -4, -4, -4, -4, -1.5]
    sums.add(np.arange(2), np.array([slope, peak], np.float32), np.ones(2, np.float32))
    parts = sums.parts(OF_MARK, np.full(2, 20.0))
    assert parts.detail == pytest.approx(np.array([0, 1.5]) * OF_MARK.blur)
    assert parts.total == pytest.approx(np.hypot(parts.photos, parts.detail))
    assert sums.parts(OF_POINT).detail == pytest.approx(np.array([0, 1.5]) * OF_POINT.blur)


def test_where_no_photo_looked_there_is_no_uncertainty():
    away = camera_before_wall().look_at([0.0, -5.0, 0.0], [0.0, -10.0, 0.0])
    values = render_wall(away)[THERMAL].image.float()
    view = View("away", {THERMAL: PosedImage(away, lambda: Pixels(values))})
    meter = meter_of(views=[view])
    assert meter.read(BOX).uncertainty is None
    points = np.array([[0.5, 0.0, 0.5]], np.float32)
    assert np.isnan(meter.uncertainty.of_points(points, np.array([20.0], np.float32))).all()
    assert math.isnan(meter.uncertainty.of_mark(points, np.array([20.0])).total)


def test_points_have_the_uncertainty_of_a_map():
    budget = Budget(accuracy=(2.0, 0.0))
    points = np.array([[0.5, 0.0, 0.5]], np.float32)
    (found,) = meter_of(budget).uncertainty.of_points(points, np.array([21.5], np.float32))
    assert found == pytest.approx(
        math.hypot(0.95 * 2, 2 * OF_POINT.scatter * np.std(SHIFTS_C)), rel=0.05
    )


def test_points_in_an_area_have_the_uncertainty_of_its_settings():
    budget = Budget(CAPTURE, SETTINGS, accuracy=(2.0, 0.0))
    meter = meter_of(budget)
    own = replace(BOX, emissivity=0.5, reflected_c=10.0)
    points = np.array([[0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]], np.float32)
    values = np.array([21.5, 19.5], np.float32)
    found = meter.uncertainty.of_points(points, values, meter.regions(Marks((own,))))
    inner, outer = (Uncertainty(photos=x) for x in meter.uncertainty.of_photos(points).tolist())
    wanted = of_place(budget, inner, 21.5, SurfaceSettings(0.5, 10.0)).total
    assert found == pytest.approx([wanted, of_place(budget, outer, 19.5).total], rel=1e-5)
    assert found[0] == pytest.approx(meter.read(own).uncertainty.total, rel=0.1)
    assert found[0] > 1.5 * found[1]


def test_a_surface_that_cannot_have_its_settings_has_no_uncertainty():
    meter = meter_of(Budget(CAPTURE, SETTINGS))
    regions = meter.regions(Marks((replace(BOX, emissivity=0.1, reflected_c=55.0),)))
    points = np.array([[0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]], np.float32)
    found = meter.uncertainty.of_points(points, np.full(2, 20.0, np.float32), regions)
    assert np.isnan(found).tolist() == [True, False]


@pytest.mark.parametrize("odd_c", [12.5, 12.0, 11.5, 11.0, 10.5, 10.0, 9.5])
def test_one_odd_pixel_leaves_the_uncertainty_of_a_mark_as_it_is(odd_c):
    """At 9.5 °C the reflection alone would be more than what was measured; above, with one of the
    settings or the reading changed by its uncertainty."""
    budget = Budget(CAPTURE, SETTINGS, accuracy=(2.0, 0.0))
    bare_metal, values = SurfaceSettings(0.15, 20.0), np.full(100, 16.0)
    surfaces = [(bare_metal, np.ones(100, bool))]
    even = budget.of_mean(Uncertainty(0.1, 0.1, 0.1), values, surfaces)
    values[40] = odd_c
    odd = budget.of_mean(Uncertainty(0.1, 0.1, 0.1), values, surfaces)
    assert odd.total == pytest.approx(even.total, rel=0.05)
    assert odd.known == pytest.approx(even.known, rel=0.1)
    on_map = budget.together(np.full(1, 0.1), np.array([odd_c]), bare_metal)
    assert np.isnan(on_map) == np.isnan(CAPTURE.corrected(np.array([odd_c]), bare_metal))


def test_the_one_sided_sensitivity_to_a_small_emissivity_is_by_the_side_that_is_left():
    """An emissivity is varied down to 0.01 at least: its ends may not be equally far."""
    budget = Budget(CAPTURE, emissivity=0.02)
    shiny, celsius = SurfaceSettings(0.02, 20.0), np.array([18.88])
    nominal, more = (
        CAPTURE.corrected(celsius, replace(shiny, emissivity=each))[0] for each in (0.02, 0.04)
    )
    assert np.isnan(CAPTURE.corrected(celsius, replace(shiny, emissivity=0.01)))
    (part,) = budget.contributions(celsius, shiny)[InputQuantity("emissivity", 0.02)]
    assert part == pytest.approx(2 * (more - nominal))


def test_the_data_sheet_is_a_limit_and_cancels_in_differences():
    budget = Budget(accuracy=(1.0, 10.0))
    other = replace(BOX, name="B2", points=tuple((x - 1.5, y, z) for x, y, z in BOX.points))
    one, two = meter_of(budget).measure(Marks((BOX, other), reference="B1"))
    camera = [each.uncertainty.known["camera"] for each in (one, two)]
    assert camera[0] == pytest.approx(0.95 * 2.15, rel=0.01)
    assert two.difference_uncertainty < camera[1]
    # Of 10 % of the reading their difference is left.
    assert two.difference_uncertainty == pytest.approx(
        math.hypot(one.uncertainty.own, two.uncertainty.own, camera[0] - camera[1])
    )
    assert math.isnan(one.difference_uncertainty)


def test_samples_of_a_line_have_the_uncertainty_of_points():
    line = Mark("L1", "line", ((-0.5, 0.0, 0.5), (0.5, 0.0, 0.5)), EYE)
    profile = meter_of(Budget(accuracy=(2.0, 0.0))).read(line).profile
    photos = OF_POINT.scatter * np.std(SHIFTS_C) * (1 + FEW_PHOTOS / 2)
    assert profile.uncertainties.shape == profile.values.shape
    assert np.nanmedian(profile.uncertainties) == pytest.approx(np.hypot(photos, 1.9), abs=0.02)


def test_photos_that_show_none_of_the_points_are_not_rendered():
    seen = photo_of_wall(1, 0.0)
    camera = seen.images[THERMAL].camera
    behind = camera.look_at([0.0, -5.0, 0.0], [0.0, -9.0, 0.0])
    away = View("away", {THERMAL: replace(seen.images[THERMAL], camera=behind)})
    rendered = []

    def render(camera):
        rendered.append(camera)
        return render_wall(camera)

    PhotoReadings(render, ideal_cameras, [seen, away], RANGE).of_points(
        np.array(BOX.points, np.float32)
    )
    assert len(rendered) == 1


def test_a_real_camera_is_uneven_from_place_to_place():
    budget = Budget(evenness=0.2)
    other = replace(BOX, name="B2", points=tuple((x - 1.5, y, z) for x, y, z in BOX.points))
    one, two = meter_of(budget).measure(Marks((BOX, other), reference="B1"))
    assert one.uncertainty.known["evenness"] == pytest.approx(0.2)
    assert one.uncertainty.total == pytest.approx(math.hypot(one.uncertainty.own, 0.2))
    assert two.difference_uncertainty == pytest.approx(
        math.hypot(one.uncertainty.own, two.uncertainty.own, 0.2, 0.2)
    )
    same = replace(BOX, name="B2")
    assert meter_of(budget).measure(Marks((BOX, same), reference="B1"))[
        1
    ].difference_uncertainty == pytest.approx(math.sqrt(2) * one.uncertainty.own)
    photos = drifting_scene()  # of which no camera is named
    view = photos.train[0]
    image = replace(view.images[THERMAL], record=PhotoRecord(camera="WIRIS Pro"))
    known = replace(photos, train=(replace(view, images={THERMAL: image}), *photos.train[1:]))
    assert [Budget.of(each, Survey()).evenness for each in (known, photos)] == [0.2, 0.0]


@pytest.mark.parametrize(("celsius", "limit_c"), [(5.0, 1.0), (40.0, 4.0), (-40.0, 4.0)])
def test_the_per_cent_of_the_data_sheet_count_below_zero_too(celsius, limit_c):
    budget = Budget(accuracy=(1.0, 10.0))
    found = of_place(budget, Uncertainty(0.0, 0.0), celsius)
    assert found.known["camera"] == pytest.approx(0.95 * limit_c)
    assert budget.together(np.zeros(1), np.array([celsius])) == pytest.approx(found.known["camera"])


@pytest.mark.parametrize("other_c", [0.0, 0.1, 0.3, 1.0, 3.0])
def test_a_limit_of_error_and_other_parts_together_hold_95_of_100_cases(other_c):
    """The error of a camera is anywhere within its limit, that of the rest is normal."""
    rng = np.random.default_rng(0)
    errors = rng.uniform(-2.0, 2.0, 100_000) + other_c / 2 * rng.normal(size=100_000)
    found = of_place(Budget(accuracy=(2.0, 0.0)), Uncertainty(other_c, 0.0), 20.0)
    assert 0.93 < np.mean(np.abs(errors) < found.total) < 0.97


def test_settings_are_varied_by_their_uncertainties():
    budget = Budget(CAPTURE, SETTINGS, emissivity=0.03, reflected_c=5.0, distance_percent=50.0)
    found = of_place(budget, Uncertainty(0.1, 0.2), 40.0)
    at = np.array([40.0])
    ends = [CAPTURE.corrected(at, SurfaceSettings(each, 20.0))[0] for each in (0.92, 0.98)]
    assert found.known["emissivity"] == pytest.approx(ends[0] - ends[1])
    ends = [CAPTURE.corrected(at, SurfaceSettings(0.95, each))[0] for each in (15.0, 25.0)]
    assert found.known["reflected"] == pytest.approx(ends[0] - ends[1])
    # 4 m of air at 10 °C let some 1 % less through, before an object 30 K warmer.
    assert 0.1 < found.known["distance"] < 0.6
    assert (found.photos, found.model) == (0.1, 0.2)


def test_the_distance_is_varied_as_the_measurement_formula_has_it():
    law = Planck(21_106.77, 0.012545258, 1501.0, 1.0, -7340.0)
    signal = np.array([law.signal(40.0)])
    at_8_m, at_4_m, at_12_m = (
        Measurement(law, SETTINGS, USUAL_AIR.transmission(distance_m, 10.0, 0.5)).celsius(signal)[0]
        for distance_m in (8.0, 4.0, 12.0)
    )
    budget = Budget(replace(CAPTURE, law=law), SETTINGS, distance_percent=50.0)
    found = of_place(budget, Uncertainty(0.1, 0.2), at_8_m)
    assert at_12_m > at_4_m + 0.1
    assert found.known["distance"] == pytest.approx(at_12_m - at_4_m)


def test_a_surface_with_a_small_emissivity_magnifies_what_photos_disagree_by():
    budget = Budget(CAPTURE, SETTINGS)
    dull, shiny = (
        of_place(budget, Uncertainty(0.1, 0.0), 40.0, SurfaceSettings(each, 20.0))
        for each in (0.95, 0.3)
    )
    assert shiny.photos > 2 * dull.photos
    ends = CAPTURE.corrected(np.array([39.9, 40.1]), SurfaceSettings(0.3, 20.0))
    assert shiny.photos == pytest.approx(0.1 * (ends[1] - ends[0]) / 0.2, rel=1e-3)
    assert shiny.known["emissivity"] > 5 * dull.known["emissivity"]


def test_a_box_with_its_own_emissivity_is_corrected_before_it_is_doubted():
    budget = Budget(CAPTURE, SETTINGS)
    plain = meter_of(budget).read(BOX)
    own = meter_of(budget).measure(Marks((replace(BOX, emissivity=0.5),)))[0]
    assert own.mean != pytest.approx(plain.mean, abs=0.5)
    assert own.uncertainty.photos > 1.5 * plain.uncertainty.photos
    assert own.uncertainty.known["emissivity"] > plain.uncertainty.known["emissivity"]


def test_what_is_assumed_is_said():
    (note,) = Budget.of(None, Survey()).notes
    assert "accuracy" in note
    stated = Budget.of(None, Survey(camera_accuracy_c=1.0))
    assert (stated.accuracy, stated.notes) == ((1.0, 0.0), ())


def test_a_camera_that_only_the_survey_names_has_the_usual_errors():
    named = Budget.of(None, Survey(camera="FLIR T540"))
    assert (named.accuracy, named.evenness) == ((2.0, 2.0), 0.2)


def test_per_cent_alone_do_not_make_the_camera_exact_about_0_degrees():
    """Data sheets say ± 2 °C or 2 %, whichever is greater."""
    budget = Budget.of(None, Survey(camera_accuracy_percent=3.0))
    assert budget.accuracy == (2.0, 3.0)
    assert "± 2 °C" in budget.notes[0]
    assert "3 %" in budget.notes[0]
    parts = Uncertainty(0.1, 0.0)
    assert of_place(budget, parts, 5.0).known["camera"] == pytest.approx(0.95 * 2)
    assert of_place(budget, parts, 100.0).known["camera"] == pytest.approx(0.95 * 3)


def test_panels_show_the_uncertainty_and_its_parts():
    reading = meter_of(Budget(accuracy=(2.0, 0.0))).read(BOX)
    text = mark_text(reading, "", RANGE, WorldFrame())
    assert text["value"].endswith("± 2.0 °C")
    assert "photos 0.5, model 0." in text["lines"][1]
    assert text["lines"][1].endswith("data sheet 1.9")


def test_panels_say_that_the_camera_is_no_part_of_the_uncertainty():
    """± alone would promise that the truth lies within it."""
    text = mark_text(meter_of().read(BOX), "", RANGE, WorldFrame())
    assert "without the camera's" in text["lines"][1]
