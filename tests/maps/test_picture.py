from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from mrgs.maps.draw import MARGIN, OrthographicMap, bar_length, frame_map, map_body
from mrgs.maps.surfaces import MapGrid
from mrgs.pictures.drawing import PAPER, Scale

SIZE = 600


@pytest.mark.parametrize("angle", [0.0, 180.0, -65.0])
def test_the_n_of_the_arrow_lies_towards_north(angle):
    body, scale = Image.new("RGB", (SIZE, SIZE), PAPER), Scale("grey", 0.0, 1.0, "°C")
    without, framed = (
        np.asarray(frame_map(body, 0.01, scale, north_deg).convert("L"), float)
        for north_deg in (None, angle)
    )
    y, x = np.nonzero(np.abs(framed - without) > 60)
    x, y = x - (MARGIN + SIZE - 24), y - (SIZE + 2 * MARGIN + 10)
    tip = np.hypot(x, y) > 25
    assert tip.sum() > 20
    found = np.degrees(np.arctan2(x[tip].mean(), -y[tip].mean()))
    assert abs((found - angle + 180) % 360 - 180) < 4


@pytest.mark.parametrize(("width", "shown"), [(60, 900), (901, 901), (4800, 2400)])
def test_a_pixel_of_the_picture_is_as_wide_as_it_is_said_to_be(width, shown):
    grid = MapGrid(np.eye(3), 1.0, np.zeros(2), 0.0, 0.0, 0.05, width, 20, (-1.0, 1.0))
    drawn = OrthographicMap(
        grid, np.ones((7, 20, width), np.float32), np.zeros((20, width, 3), np.float32)
    )
    body, metres_per_px = map_body(drawn, Scale("grey", 0.0, 2.0, "°C"))
    assert body.width == shown
    assert metres_per_px * body.width == pytest.approx(0.05 * width)


@pytest.mark.parametrize(
    ("metres_per_px", "labels", "length_px"),
    [
        (0.01, ["0.0", "0.5", "1.0 m"], 100),
        (0.03, ["0", "2", "4 m"], 400 / 3),
        (0.002, ["0", "10", "20 cm"], 100),
        (0.00002, ["0", "1", "2 mm"], 100),
    ],
)
def test_the_scale_bar_has_a_round_length_and_its_unit(metres_per_px, labels, length_px):
    found_px, found = bar_length(SIZE, metres_per_px, ".")
    assert found == labels
    assert found_px == pytest.approx(length_px)
    body, scale = Image.new("RGB", (SIZE, SIZE), PAPER), Scale("grey", 0.0, 1.0, "°C")
    framed = np.asarray(frame_map(body, metres_per_px, scale, None).convert("L"))
    top_edge = framed[SIZE + 2 * MARGIN, :SIZE]
    assert (top_edge < 100).sum() == pytest.approx(length_px, abs=2)
