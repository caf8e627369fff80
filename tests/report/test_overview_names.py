"""Names of marks over pictures."""

from __future__ import annotations

import random
import sys
from itertools import combinations
from types import FrameType

import numpy as np
import pytest
from PIL import Image

from mrgs.marks import Mark
from mrgs.pictures import drawing
from mrgs.pictures.drawing import RING_PX, Box, draw_names
from mrgs.report.overview import (
    MARK,
    SMALL_PX,
    draw_marks,
    draw_place,
    small_picture,
)

SIZE = (900, 675)


def places(count: int) -> dict[str, tuple[float, float]]:
    """Places on a house that takes up half of the picture."""
    rng = random.Random(count)
    return {f"S{i}": (rng.uniform(200, 700), rng.uniform(150, 500)) for i in range(count)}


def overlap(one: Box, other: Box) -> bool:
    return max(one[0], other[0]) < min(one[2], other[2]) and max(one[1], other[1]) < min(
        one[3], other[3]
    )


@pytest.mark.parametrize("count", [1, 6, 40])
def test_names_of_many_marks_cover_neither_each_other_nor_a_mark(count: int):
    where = places(count)
    plates = [*draw_names(Image.new("RGB", SIZE), where).values()]
    assert len(plates) == count
    rings = [(x - RING_PX, y - RING_PX, x + RING_PX, y + RING_PX) for x, y in where.values()]
    assert not any(overlap(*pair) for pair in combinations(plates, 2))
    assert not any(overlap(plate, ring) for plate in plates for ring in rings)
    assert all(box[0] >= 0 and box[1] >= 0 for box in plates)
    assert all(box[2] <= SIZE[0] and box[3] <= SIZE[1] for box in plates)


@pytest.mark.parametrize("size", [(900, 300), (300, 900)])
def test_names_at_the_edges_of_a_picture_stay_within_it(size: tuple[int, int]):
    width, height = size
    where = {
        f"S{x}{y}": (x * width + 30.0 * (1 - 2 * x), y * height + 30.0 * (1 - 2 * y))
        for x in (0, 1)
        for y in (0, 1)
    }
    plates = draw_names(Image.new("RGB", size), where)
    assert plates.keys() == where.keys()
    for name, (left, top, right, bottom) in plates.items():
        x, y = where[name]
        assert left >= 0
        assert top >= 0
        assert right <= width
        assert bottom <= height
        assert left - 60 < x < right + 60
        assert top - 60 < y < bottom + 60


def test_a_name_costs_no_more_among_hundreds():
    """With all boxes compared with each other, the calls would grow with the square."""
    calls = 0

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += "call" in event and frame.f_code.co_filename == drawing.__file__

    image, where, before = Image.new("RGB", SIZE), places(200), sys.getprofile()
    sys.setprofile(count)
    try:
        plates = [*draw_names(image, where).values()]
    finally:
        sys.setprofile(before)
    assert len(plates) > 50
    assert not any(overlap(*pair) for pair in combinations(plates, 2))
    assert 100 * len(where) < calls < 2_000 * len(where)


def test_many_names_leave_most_of_the_picture_free():
    picture = Image.new("RGB", SIZE, "white")
    draw_names(picture, places(40))
    assert (np.asarray(picture).min(axis=2) < 100).mean() < 0.08


def test_a_long_name_takes_no_more_than_half_of_the_width():
    ((left, _, right, _),) = draw_names(Image.new("RGB", SIZE), {"W" * 40: (450.0, 300.0)}).values()
    assert right - left < 0.52 * SIZE[0]


CORNERS = np.array([[200.0, 150.0], [700.0, 150.0], [700.0, 500.0], [200.0, 500.0]])
SIDES = [(450, 150), (700, 325), (450, 500), (200, 325)]
"""The middles of the sides, the last between the last corner and the first."""


def four_corners(kind: str) -> Mark:
    points = tuple((x, 0.0, y) for x, y in CORNERS.tolist())
    return Mark("A1", kind, points, (0.0, -9.0, 0.0))


@pytest.mark.parametrize(("kind", "is_closed"), [("box", True), ("polygon", True), ("line", False)])
def test_the_outline_of_an_area_is_closed(kind, is_closed):
    photo, plan = (Image.new("RGB", SIZE, (90, 90, 90)) for _ in range(2))
    draw_marks(photo, {"A1": four_corners(kind)}, {"A1": CORNERS})
    draw_place(plan, four_corners(kind), CORNERS, 6.0)
    expected = [True, True, True, is_closed]
    assert [photo.getpixel(side) == (255, 255, 255) for side in SIDES] == expected
    assert [plan.getpixel(side) == MARK for side in SIDES] == expected


@pytest.mark.parametrize("size", [(900, 300), (300, 900), (100, 50)])
def test_a_small_picture_has_one_size_and_its_proportions(size):
    small = small_picture(Image.new("RGB", size))
    assert max(small.size) == SMALL_PX
    assert small.width / small.height == pytest.approx(size[0] / size[1], rel=0.01)
