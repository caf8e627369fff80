from __future__ import annotations

import numpy as np
import pytest

from mrgs.viewer.annotation import Outline, PointLabel, annotate, seen_outlines
from mrgs.viewer.painting import compose, measure_scales
from mrgs.viewer.settings import Settings
from tests.helpers.panes import RANGE, SIZE, heat, thermal_pane


def compose_one(camera, depth: float = 3.0, **extras) -> np.ndarray:
    pane, settings = thermal_pane(camera), Settings(palette="grey")
    fields = heat(depth)
    scales = measure_scales([pane], [fields], settings, RANGE)
    picture = compose(SIZE, [pane], [fields], scales, settings)
    return annotate(picture, [pane], [fields], scales, **extras)


def test_marks_stand_where_their_points_are_seen(camera):
    changed = (
        compose_one(camera, marks=[PointLabel(np.zeros(3), "S1  20.0 °C")]) != compose_one(camera)
    ).any(axis=2)
    assert changed[60, 80]
    assert not changed[100:].any()


def test_marks_behind_something_are_hidden(camera):
    marks = [PointLabel(np.zeros(3), "S1")]
    assert (compose_one(camera, depth=2.0, marks=marks) == compose_one(camera, depth=2.0)).all()


SQUARE = np.array([[0.0, -0.5, -0.5], [0, 0.5, -0.5], [0, 0.5, 0.5], [0, -0.5, 0.5]])


def test_outlines_are_drawn_with_their_extremes(camera):
    outline = Outline(SQUARE, True, "B1", low_at=(0.0, 0.0, 0.0), high_at=(0.0, 0.2, 0.0))
    pane = thermal_pane(camera)
    (seen,) = seen_outlines(pane, heat(), [outline])
    assert seen.low == pytest.approx((0.5, 0.5))
    assert seen.corners[0] == pytest.approx((seen.corners[3][0], 1 - seen.corners[3][1]))
    image = compose_one(camera, outlines=[outline])
    assert (image[60, 80] == (70, 150, 255)).all()
    assert (compose_one(camera)[60, 80] != (70, 150, 255)).any()
    y, x = (round(seen.corners[0][i] * size) for i, size in ((1, 120), (0, 160)))
    assert (image[y, x] == 255).all()


def test_outlines_behind_something_or_behind_the_camera_are_hidden(camera):
    pane, outline = thermal_pane(camera), Outline(SQUARE, True, "B1")
    assert seen_outlines(pane, heat(depth=2.0), [outline]) == []
    around = Outline(np.array([[0.0, 0, 0], [6.0, 0, 0]]), False, "L1")
    assert seen_outlines(pane, heat(), [around]) == []
