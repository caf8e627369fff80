from __future__ import annotations

from dataclasses import replace

from mrgs.scene import WorldFrame
from mrgs.viewer.facts import point_text
from mrgs.viewer.inspection import Inspection
from tests.helpers.subjects import subject_of


def test_depths_have_the_unit_of_the_scene(small_run, balls, tmp_path):
    inspection = Inspection(subject_of(small_run, balls, tmp_path))
    inspection.picture(balls.train[0].camera.resized(160, 120))
    reading = inspection.click(0.5, 0.5)
    subject = inspection.subject
    metric = replace(subject, scene=replace(balls, world=WorldFrame(metric=True)))
    depths = [
        next(line for line in point_text(reading, each)["lines"] if line.startswith("depth"))
        for each in (metric, subject, replace(subject, scene=None))
    ]
    assert depths[0] == depths[1].replace("scene units", "m")
    assert depths[0].endswith(" m")
    assert depths[1] == depths[2]
