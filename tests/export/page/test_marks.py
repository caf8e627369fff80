"""What the page is told of marks."""

from __future__ import annotations

from types import SimpleNamespace

from mrgs.export.page.write import page_marks
from mrgs.marks import Mark, Marks
from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.measure import MarkMeter, MarkReading
from mrgs.marks.photo_readings import PhotoReadings
from mrgs.marks.uncertainty import Budget, UncertaintyMeter
from mrgs.scene import THERMAL, Pixels, PosedImage, View, WorldFrame, ideal_cameras
from mrgs.survey import Survey
from tests.helpers.walls import RANGE, camera_before_wall, render_wall

SPOT = Mark("S1", "spot", ((0.0, 0.0, 0.0),), (0.0, -5.0, 0.0), 0.1)


def test_the_page_says_that_the_accuracy_of_the_camera_is_not_known():
    camera = camera_before_wall()
    photo = Pixels(render_wall(camera)[THERMAL].image.float())
    view = View("v", {THERMAL: PosedImage(camera, lambda: photo)})
    witnesses = PhotoReadings(render_wall, ideal_cameras, [view], RANGE)
    uncertainty = UncertaintyMeter(witnesses, Budget.of(None, Survey()))
    marks = SimpleNamespace(
        marks=Marks((SPOT,)),
        run=SimpleNamespace(temperature=RANGE),
        meter=MarkMeter(render_wall, RANGE, [camera], uncertainty=uncertainty),
        world=WorldFrame(),
    )
    (shown,), notes = page_marks(marks)
    assert shown["label"].startswith("S1  20.0 ± ")
    (note,) = notes
    assert "accuracy" in note


def test_an_area_says_what_it_is_corrected_for_as_a_spot_within_it_does():
    corners = tuple((x, 0.0, z) for x, z in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)))
    area = Mark("B1", "box", corners, SPOT.eye, emissivity=0.5, reflected_c=-10.0)
    surface = SurfaceSettings(0.5, -10.0)
    readings = [MarkReading(mark, mean=0.5, surface=surface) for mark in (area, SPOT)]
    marks = SimpleNamespace(
        marks=Marks((area, SPOT)),
        run=SimpleNamespace(temperature=RANGE),
        meter=SimpleNamespace(
            measure=lambda _: readings, uncertainty=None, capture=CaptureSettings()
        ),
        world=WorldFrame(),
    )
    shown, _ = page_marks(marks)
    for each in shown:
        (said,) = (line for line in each["lines"] if "ε 0.5" in line)
        assert "−10.0 °C" in said


def test_what_is_assumed_of_the_surface_is_said_where_an_area_has_an_emissivity():
    corners = tuple((x, 0.0, z) for x, z in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)))
    area = Mark("B1", "box", corners, SPOT.eye, emissivity=0.5, reflected_c=-10.0)
    capture = CaptureSettings.of(None)
    assert capture.notes

    def notes(*drawn: Mark) -> tuple[str, ...]:
        readings = [MarkReading(mark, mean=0.5) for mark in drawn]
        meter = SimpleNamespace(measure=lambda _: readings, uncertainty=None, capture=capture)
        run = SimpleNamespace(temperature=RANGE)
        return page_marks(
            SimpleNamespace(marks=Marks(drawn), run=run, meter=meter, world=WorldFrame())
        )[1]

    assert notes(SPOT) == ()
    assert notes(SPOT, area) == capture.notes
