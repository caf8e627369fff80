from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from mrgs.viewer.painting import (
    DrawnPicture,
    MarkLabel,
    annotate,
    compose,
    measure_scales,
    seen_labels,
)
from mrgs.viewer.settings import Settings
from tests.helpers.panes import RANGE, SIZE, heat, thermal_pane


def compose_one(camera, depth: float = 3.0, labels: Sequence[MarkLabel] = ()) -> np.ndarray:
    pane, settings = thermal_pane(camera), Settings(palette="grey")
    fields = heat(depth)
    scales = measure_scales([pane], [fields], settings, RANGE)
    picture = compose(SIZE, [pane], [fields], scales, settings)
    return annotate(DrawnPicture(camera, (pane,), (fields,), scales, picture), labels)


def test_marks_stand_where_their_points_are_seen(camera):
    labels = [MarkLabel(np.zeros((1, 3)), "S1  20.0 °C")]
    changed = (compose_one(camera, labels=labels) != compose_one(camera)).any(axis=2)
    assert changed[60, 80]
    assert not changed[100:].any()


def test_marks_behind_something_are_hidden(camera):
    labels = [MarkLabel(np.zeros((1, 3)), "S1")]
    assert (compose_one(camera, depth=2.0, labels=labels) == compose_one(camera, depth=2.0)).all()


SQUARE = np.array([[0.0, -0.5, -0.5], [0, 0.5, -0.5], [0, 0.5, 0.5], [0, -0.5, 0.5]])


def test_outlines_are_drawn_with_their_extremes(camera):
    outline = MarkLabel(SQUARE, "B1", "", True, (0.0, 0.0, 0.0), (0.0, 0.2, 0.0))
    pane = thermal_pane(camera)
    (seen,) = seen_labels(pane, heat(), [outline])
    assert seen.low == pytest.approx((0.5, 0.5))
    assert seen.corners[0] == pytest.approx((seen.corners[3][0], 1 - seen.corners[3][1]))
    image = compose_one(camera, labels=[outline])
    assert (image[60, 80] == (70, 150, 255)).all()
    assert (compose_one(camera)[60, 80] != (70, 150, 255)).any()
    y, x = (round(seen.corners[0][i] * size) for i, size in ((1, 120), (0, 160)))
    assert (image[y, x] == 255).all()


def test_outlines_behind_something_or_behind_the_camera_are_hidden(camera):
    pane, outline = thermal_pane(camera), MarkLabel(SQUARE, "B1", closed=True)
    assert seen_labels(pane, heat(depth=2.0), [outline]) == []
    around = MarkLabel(np.array([[0.0, 0, 0], [6.0, 0, 0]]), "L1")
    assert seen_labels(pane, heat(), [around]) == []
