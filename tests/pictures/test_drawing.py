from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from mrgs.pictures.drawing import (
    Scale,
    draw_text,
    drawable,
    fit_text,
    scale_bar,
    text_width,
)
from mrgs.pictures.palette import palette_table

IRON = Scale("iron", 10.0, 30.0, "°C")


def test_a_horizontal_bar_runs_from_cold_to_warm() -> None:
    bar = np.asarray(scale_bar(IRON, 300, "horizontal"))
    assert bar.shape[1] == 300
    np.testing.assert_array_equal(bar[0, [0, -1]], palette_table("iron")[[0, -1]])


def test_a_vertical_bar_has_its_warm_end_on_top() -> None:
    bar = np.asarray(scale_bar(IRON, 200, "vertical"))
    assert bar.shape[0] == 200
    np.testing.assert_array_equal(bar[[0, -1], 0], palette_table("iron")[[-1, 0]])


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_the_labels_follow_the_limits(direction: str) -> None:
    bars = [
        np.asarray(scale_bar(IRON._replace(high=high), 240, direction)) for high in (30.0, 31.5)
    ]
    assert bars[0].shape != bars[1].shape or not np.array_equal(bars[0], bars[1])


def test_a_reversed_scale_puts_its_larger_number_at_the_first_color() -> None:
    forward = np.asarray(scale_bar(Scale("grey", 0.0, 4.0, ""), 240, "horizontal"))
    reverse = np.asarray(scale_bar(Scale("grey", 4.0, 0.0, ""), 240, "horizontal"))
    np.testing.assert_array_equal(forward[:8], reverse[:8])
    assert not np.array_equal(forward, reverse)


def test_text_is_cut_to_the_width() -> None:
    assert fit_text("short", 14, 500) == "short"
    cut = fit_text("a_very_long_view_name_from_a_camera", 14, 90)
    assert cut.endswith("...")
    assert text_width(cut, 14) <= 90


def test_dashes_that_the_font_lacks_are_drawn_as_hyphens() -> None:
    images = []
    for text in ("1–2", "1-2"):
        image = Image.new("RGB", (60, 20), "white")
        draw_text(image, (2, 15), text, 14)
        images.append(np.asarray(image))
    np.testing.assert_array_equal(*images)
    assert images[0].min() < 255


def test_a_minus_is_drawn_as_wide_as_a_plus() -> None:
    bars = []
    for text in ("−", "-"):
        image = Image.new("RGB", (60, 40), "white")
        draw_text(image, (30, 20), text, 30, anchor="mm")
        bars.append(np.argwhere(np.asarray(image).min(axis=2) < 128))
    minus, hyphen = bars
    assert np.ptp(minus[:, 1]) > 1.5 * np.ptp(hyphen[:, 1])
    assert minus[:, 1].mean() == pytest.approx(30, abs=1)
    assert text_width("−1", 30) == pytest.approx(text_width("+1", 30))


def test_letters_that_the_font_lacks_are_written_with_others() -> None:
    assert drawable("Türsturz groß, côté − 3 °C ± 1") == "Tuersturz gross, cote − 3 °C ± 1"
    assert drawable("m² 中") == "m2 ?"
    assert drawable("ÆRØ Łódź Đ") == "AeRO Lodz D"
