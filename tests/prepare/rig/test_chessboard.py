from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import gaussian_filter

from mrgs.prepare.rig.chessboard import Corners, detect_chessboard
from mrgs.scene.lens import Lens
from tests.helpers.rig_room import draw_board, make_board

TABLETOP = Path(__file__).parents[3] / "examples" / "tabletop"
LENS = Lens(200, 150, 190.0, 190.0, 100.0, 75.0)
BENT = Lens(200, 150, 190.0, 190.0, 95.0, 80.0, (-0.35, 0.1, 0.0, 0.0))
FRONTAL = (0.1, -0.15, 0.1, -0.27, -0.2, 1.1)
SLANTED = (0.5, -0.7, 0.3, -0.3, -0.15, 1.2)
FAR = (0.1, 0.2, -0.1, -0.3, -0.1, 1.9)
CUT_OFF = (0.0, 0.0, 0.1, -0.4, -0.3, 1.0)
RNG = np.random.default_rng(0)


def errors_px(found: Corners | None, true: np.ndarray) -> np.ndarray:
    """Distances of the corners from the true ones, in the order that fits best."""
    assert found is not None
    return min(
        (np.linalg.norm(each.pixels - true, axis=1) for each in found.orderings()), key=np.median
    )


@pytest.mark.parametrize(
    ("motion", "lens", "blur_px"),
    [
        (FRONTAL, LENS, 0.5),
        (SLANTED, LENS, 0.5),
        (FAR, LENS, 0.7),
        (FRONTAL, LENS, 2.5),
        (FRONTAL, BENT, 1.0),
    ],
    ids=["frontal", "slanted", "small", "blurred", "distorted"],
)
def test_corners_are_found_to_a_tenth_of_a_pixel(motion, lens, blur_px):
    image, true = draw_board(make_board(motion), lens, blur_px=blur_px)
    found = errors_px(detect_chessboard(image, (6, 5)), true)
    assert np.median(found) < 0.05
    assert found.max() < 0.15


def test_noise_and_low_contrast():
    image, true = draw_board(make_board(FRONTAL), LENS, shades=(21.0, 21.6), blur_px=1.0)
    noisy = image + RNG.normal(0, 0.06, image.shape)
    found = errors_px(detect_chessboard(noisy, (6, 5)), true)
    assert np.median(found) < 0.15
    assert found.max() < 0.4


def test_uneven_light():
    image, true = draw_board(make_board(FRONTAL), LENS, blur_px=1.0)
    found = errors_px(detect_chessboard(image * np.linspace(0.4, 1.0, 200), (6, 5)), true)
    assert found.max() < 0.15


def test_a_board_whose_outer_squares_are_cut_off():
    image, true = draw_board(make_board(CUT_OFF), LENS)
    assert true.min() < 18
    assert errors_px(detect_chessboard(image, (6, 5)), true).max() < 0.1


def test_a_board_with_as_many_rows_as_columns():
    image, true = draw_board(make_board(FRONTAL, inner=(5, 5)), LENS)
    found = detect_chessboard(image, (5, 5))
    assert errors_px(found, true).max() < 0.1
    assert len(found.orderings()) == 4
    assert found.spacing.shape == (5, 5)


def test_rows_are_clockwise_from_columns():
    image, _ = draw_board(make_board(SLANTED), LENS)
    grid = detect_chessboard(image, (6, 5)).grid
    assert grid.shape == (5, 6, 2)
    along, down = grid[0, 1] - grid[0, 0], grid[1, 0] - grid[0, 0]
    assert along[0] * down[1] - along[1] * down[0] > 0


@given(st.floats(0.01, 1000), st.floats(-300, 300), st.booleans())
@settings(max_examples=4, deadline=None)
def test_which_squares_are_bright_does_not_matter(drawn, scale, shift, inverted):
    image, true = drawn
    assert (
        errors_px(
            detect_chessboard((-scale if inverted else scale) * image + shift, (6, 5)), true
        ).max()
        < 0.15
    )


@pytest.fixture(scope="module")
def drawn():
    return draw_board(make_board(SLANTED), LENS)


@pytest.mark.slow
@pytest.mark.parametrize("inner", [(5, 5), (6, 4), (7, 5), (6, 6), (5, 4), (3, 3)])
def test_other_counts_are_not_found(inner, drawn):
    assert detect_chessboard(drawn[0], inner) is None


def test_a_board_that_is_partly_outside_is_not_found():
    image, _ = draw_board(make_board((0.0, 0.0, 0.1, -0.7, -0.2, 1.1)), LENS)
    assert detect_chessboard(image, (6, 5)) is None


@pytest.mark.parametrize("blur_px", [0.0, 1.0, 3.0])
def test_there_is_no_board_in_noise(blur_px):
    image = gaussian_filter(RNG.normal(size=(120, 160)), blur_px)
    assert detect_chessboard(image, (3, 3)) is None
    assert detect_chessboard(np.zeros((60, 80)), (3, 3)) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", sorted(path.name for path in (TABLETOP / "images").iterdir())[::24]
)
def test_there_is_no_board_in_a_photo_with_a_chequered_cloth(name):
    photo = np.asarray(Image.open(TABLETOP / "images" / name).convert("L"), dtype=np.float64)
    for inner in ((3, 3), (6, 5), (4, 7)):
        assert detect_chessboard(photo, inner) is None
