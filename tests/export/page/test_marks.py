"""What the page is told of marks."""

from __future__ import annotations

from types import SimpleNamespace

from mrgs.export.page.marks import page_marks
from mrgs.marks import Mark, Marks
from mrgs.marks.measure import MarkMeter
from mrgs.marks.uncertainty import UncertaintyMeter
from mrgs.marks.uncertainty.budget import Budget
from mrgs.marks.uncertainty.witnesses import PhotoWitnesses
from mrgs.scene import THERMAL, Pixels, PosedImage, View, WorldFrame, ideal_cameras
from mrgs.survey import Survey
from tests.helpers.walls import RANGE, camera_before_wall, render_wall

SPOT = Mark("S1", "spot", ((0.0, 0.0, 0.0),), (0.0, -5.0, 0.0), 0.1)


def test_the_page_says_that_the_accuracy_of_the_camera_is_not_known():
    camera = camera_before_wall()
    photo = Pixels(render_wall(camera)[THERMAL].image.float())
    view = View("v", {THERMAL: PosedImage(camera, lambda: photo)})
    witnesses = PhotoWitnesses(render_wall, ideal_cameras, [view], RANGE)
    uncertainty = UncertaintyMeter(witnesses, Budget.of(None, Survey()))
    marks = SimpleNamespace(
        marks=Marks((SPOT,)),
        run=SimpleNamespace(temperature=RANGE),
        meter=MarkMeter(render_wall, RANGE, [camera], uncertainty=uncertainty),
        world=WorldFrame(),
    )
    (shown,), notes = page_marks(marks)
    assert shown["label"].startswith("S1  20.0 ± ")
    assert notes == ("The accuracy of the thermal camera is not known, and not included.",)
