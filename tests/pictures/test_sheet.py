from __future__ import annotations

import numpy as np
import pytest

from mrgs.pictures.drawing import Scale
from mrgs.pictures.sheet import Bar, Panel, PanelRow, draw_heading, draw_section, stack

RED = np.full((30, 40, 3), (200, 10, 10), np.uint8)
BLUE = np.full((60, 80, 3), (10, 10, 200), np.uint8)
BARS = [Bar(Scale("inferno", 0.0, 30.0, "°C"), "temperature")]


def draw(*panels: Panel, rows: int = 1) -> np.ndarray:
    columns = ["a", "b", "c"][: len(panels)]
    section = draw_section(
        columns, [PanelRow("RGB", panels)] * rows, BARS, cell_px=200, label_px=80
    )
    return np.asarray(section)


def centroid(picture: np.ndarray, color: tuple[int, int, int]) -> tuple[float, float]:
    rows, columns = np.nonzero((picture == color).all(axis=2))
    return float(columns.mean()), float(rows.mean())


def test_panels_are_side_by_side_at_one_width():
    picture = draw(Panel(RED), Panel(BLUE))
    (red_x, red_y), (blue_x, blue_y) = (
        centroid(picture, (200, 10, 10)),
        centroid(picture, (10, 10, 200)),
    )
    assert blue_x - red_x == pytest.approx(208, abs=1)
    assert blue_y == pytest.approx(red_y, abs=1)
    areas = [(picture == color).all(axis=2).sum() for color in ((200, 10, 10), (10, 10, 200))]
    assert areas == [200 * 150] * 2


def test_a_row_adds_to_the_height_only():
    one, two = draw(Panel(RED)), draw(Panel(RED), rows=2)
    assert two.shape[1] == one.shape[1]
    assert two.shape[0] - one.shape[0] == 158


def test_captions_have_a_line_of_their_own():
    assert draw(Panel(RED, "caption")).shape[0] > draw(Panel(RED)).shape[0]


def test_a_missing_image_is_replaced_by_a_dash_or_nothing():
    dash, nothing = draw(Panel(RED), Panel(None)), draw(Panel(RED), Panel(None, missing=""))
    assert 0 < (dash != nothing).any(axis=2).sum() < 200


def test_a_bar_spans_its_columns():
    def painted(bar: Bar) -> tuple[int, int]:
        section = draw_section(
            ["a", "b"], [PanelRow("", [Panel(None, missing="")] * 2)], [bar],
            cell_px=200, label_px=80,
        )  # fmt: skip
        columns = np.nonzero((np.asarray(section)[140:150] != 255).any(axis=(0, 2)))[0]
        return int(columns.min()), int(columns.max())

    scale = Scale("inferno", 0.0, 1.0, "")
    assert painted(Bar(scale, "", (1, 1))) == (288, 487)
    assert painted(Bar(scale, "")) == (80, 487)


def test_a_heading_leaves_out_numbers_without_room():
    numbers = [("PSNR", "31.20 dB"), ("MAE", "0.12 °C")]
    wide = np.asarray(draw_heading(900, "scene", "line", numbers))
    assert (wide[:50, 600:] != 255).any()
    narrow = np.asarray(draw_heading(300, "scene", "line", numbers))
    assert np.array_equal(narrow, np.asarray(draw_heading(300, "scene", "line", [])))


def test_stacked_pictures_are_below_each_other_with_a_margin():
    section = draw_section(
        ["a"], [PanelRow("", [Panel(RED)])], [], cell_px=200, label_px=0, title="scene"
    )
    sheet = stack([section, section])
    assert sheet.width == section.width + 64
    assert sheet.height == 2 * section.height + 8 + 64
