from __future__ import annotations

import numpy as np
import pytest

from mrgs.comparison.panels import Block, Panel, as_drawn, draw_figure
from mrgs.pictures.drawing import Scale

RED = np.full((30, 40, 3), (200, 10, 10), np.uint8)
BLUE = np.full((60, 80, 3), (10, 10, 200), np.uint8)


def block(*panels: Panel) -> Block:
    return Block("scene", [("RGB", panels)], [(Scale("inferno", 0.0, 30.0, "°C"), "temperature")])


def centroid(picture: np.ndarray, color: tuple[int, int, int]) -> tuple[float, float]:
    rows, columns = np.nonzero((picture == color).all(axis=2))
    return float(columns.mean()), float(rows.mean())


def test_panels_stand_side_by_side_at_one_width():
    picture = np.asarray(draw_figure(["a", "b"], [block(Panel(RED), Panel(BLUE))], 200))
    (red_x, red_y), (blue_x, blue_y) = (
        centroid(picture, (200, 10, 10)),
        centroid(picture, (10, 10, 200)),
    )
    assert blue_x - red_x == pytest.approx(206, abs=1)
    assert blue_y == pytest.approx(red_y, abs=1)
    areas = [(picture == color).all(axis=2).sum() for color in ((200, 10, 10), (10, 10, 200))]
    assert areas == [200 * 150] * 2


def test_blocks_stand_below_each_other():
    one = draw_figure(["a"], [block(Panel(RED))], 200)
    two = draw_figure(["a"], [block(Panel(RED)), block(Panel(BLUE))], 200)
    assert two.width == one.width
    assert two.height - one.height > 150
    picture = np.asarray(two)
    assert centroid(picture, (10, 10, 200))[1] > centroid(picture, (200, 10, 10))[1] + 150


def test_a_missing_image_leaves_a_dash_or_nothing():
    dash = np.asarray(draw_figure(["a", "b"], [block(Panel(RED), Panel(None))], 200))
    nothing = np.asarray(draw_figure(["a", "b"], [block(Panel(RED), Panel(None, missing=""))], 200))
    assert 0 < (dash != nothing).any(axis=2).sum() < 200


def test_a_block_at_its_size_holds_no_more_than_what_is_drawn():
    picture = np.random.default_rng(3).integers(0, 256, (317, 411, 3), dtype=np.uint8)
    whole = block(Panel(picture, "caption"), Panel(RED), Panel(None))
    small = as_drawn(whole, 200)
    ((_, panels),) = small.rows
    assert [None if panel.image is None else panel.image.shape for panel in panels] == [
        (154, 200, 3),
        (150, 200, 3),
        None,
    ]
    columns = ["a", "b", "c"]
    assert (
        draw_figure(columns, [small], 200).tobytes() == draw_figure(columns, [whole], 200).tobytes()
    )


def test_nothing_to_draw():
    with pytest.raises(ValueError, match="one block"):
        draw_figure(["a"], [], 200)
