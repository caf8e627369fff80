from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from mrgs.method.start.start_points import READ_PHOTOS, photo_values, with_neighbours_values
from mrgs.scene import Camera, Pixels, PosedImage

WIDTH, HEIGHT = 12, 8


def temperatures(points: Tensor, photos: list[PosedImage]) -> Tensor:
    return photo_values(points, photos, 1)[:, 0]


def photo(values: Tensor, valid: Tensor | None = None, x: float = 0.0) -> PosedImage:
    """Looks along z from a place on the x axis; a pixel is 0.1 units wide at z = 1."""
    K = torch.tensor([[10.0, 0, WIDTH / 2], [0, 10.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    return PosedImage(
        Camera(K, viewmat, WIDTH, HEIGHT), lambda: Pixels(values.float()[..., None], valid)
    )


def constant(value: float, x: float = 0.0) -> PosedImage:
    return photo(torch.full((HEIGHT, WIDTH), value), x=x)


def in_pixel(row: int, column: int, depth: float = 1.0) -> list[float]:
    """A point in the middle of a pixel of the photo taken from the origin."""
    return [(column + 0.5 - WIDTH / 2) / 10 * depth, (row + 0.5 - HEIGHT / 2) / 10 * depth, depth]


def test_a_point_gets_the_value_of_its_own_pixel():
    values = torch.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) / 100
    places = [(0, 0), (0, 11), (7, 0), (5, 3)]
    points = torch.tensor([in_pixel(row, column, 2.0) for row, column in places])
    expected = torch.tensor([values[place] for place in places])
    torch.testing.assert_close(temperatures(points, [photo(values)]), expected)


def test_colours_are_medians_channel_by_channel():
    camera = constant(0.0).camera
    colors = torch.tensor([[0.1, 0.5, 0.9], [0.2, 0.4, 0.8], [0.3, 0.6, 0.7]])
    photos = [
        PosedImage(camera, lambda c=c: Pixels(c.expand(HEIGHT, WIDTH, 3).clone())) for c in colors
    ]
    found = photo_values(torch.tensor([[0.0, 0.0, 1.0]]), photos, 3)
    torch.testing.assert_close(found, torch.tensor([[0.2, 0.5, 0.8]]))


def test_the_median_leaves_out_the_photo_where_something_stands_before_the_point():
    photos = [constant(0.7, -0.1), constant(0.1), constant(0.72, 0.1)]
    assert temperatures(torch.tensor([[0.0, 0.0, 1.0]]), photos).item() == pytest.approx(0.7)


def test_photos_that_show_something_nearer_do_not_count():
    """Of three photos two show a wall before the point, and so its temperature."""
    wall = torch.cartesian_prod(
        torch.arange(-0.6, 0.6, 0.02), torch.arange(-0.4, 0.4, 0.02), torch.ones(1)
    )
    point = torch.tensor([[0.02, 0.02, 5.0]])
    photos = [constant(0.9), constant(0.9, 0.1), constant(0.2, 2.5)]
    hidden_in_two = torch.cat([point, wall])
    assert temperatures(hidden_in_two, photos)[0].item() == pytest.approx(0.2)
    assert temperatures(point, photos)[0].item() == pytest.approx(0.9)
    assert temperatures(hidden_in_two, photos[:2])[0].item() == pytest.approx(0.9)


@pytest.mark.parametrize(
    "point",
    [in_pixel(3, 12), in_pixel(-1, 4), in_pixel(3, 4, -1.0), [0.0, 0.0, 0.0]],
    ids=["right of the frame", "above it", "behind the camera", "at the camera"],
)
def test_a_point_that_no_photo_shows_has_no_value(point):
    assert temperatures(torch.tensor([point]), [constant(0.9)]).isnan().all()


def test_invalid_pixels_do_not_count():
    values = torch.full((HEIGHT, WIDTH), 0.9)
    valid = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    valid[3, 4] = False
    points = torch.tensor([in_pixel(3, 4), in_pixel(3, 5)])
    assert temperatures(points, [photo(values, valid)]).tolist() == pytest.approx(
        [math.nan, 0.9], nan_ok=True
    )


def test_without_photos_none_has_a_value():
    assert temperatures(torch.zeros(3, 3), []).isnan().all()


def test_of_many_photos_some_are_read_evenly_spread():
    read = []

    def noted(index: int) -> PosedImage:
        image = constant(index / 1000)
        return PosedImage(image.camera, lambda: read.append(index) or image.load())

    found = temperatures(torch.tensor([[0.0, 0.0, 1.0]]), [noted(index) for index in range(200)])
    assert len(read) == READ_PHOTOS
    assert read[0] == 0
    assert read[-1] == 199
    assert found.item() == pytest.approx(0.1, abs=0.005)


def test_a_large_photo_is_looked_at_in_fewer_pixels():
    values = torch.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) / 100
    small = values[::2, ::2] + 1
    whole = photo(values)
    looked_at = PosedImage(
        whole.camera, whole.load, load_at_least=lambda width: Pixels(small[..., None])
    )
    places = [(0, 0), (1, 11), (7, 0), (5, 3)]
    points = torch.tensor([in_pixel(row, column, 2.0) for row, column in places])
    expected = torch.tensor([small[row // 2, column // 2] for row, column in places])
    torch.testing.assert_close(temperatures(points, [looked_at]), expected)


def test_a_point_without_a_value_takes_its_neighbours():
    positions = torch.tensor([[0.0, 0, 0], [3.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0]])
    values = torch.tensor([[0.2, 0.4], [0.7, 0.9], [torch.nan, torch.nan], [torch.nan, torch.nan]])
    found = with_neighbours_values(positions, values)
    assert torch.equal(found[:2], values[:2])
    torch.testing.assert_close(found[2], 0.8 * values[0] + 0.2 * values[1])
    torch.testing.assert_close(found[3], values[0])


def test_only_the_nearest_neighbours_tell():
    positions = torch.tensor([[float(place), 0, 0] for place in range(1, 12)] + [[0.0, 0, 0]])
    values = torch.tensor([[0.1]] * 8 + [[0.9]] * 3 + [[torch.nan]])
    assert with_neighbours_values(positions, values)[-1].item() == pytest.approx(0.1)


def test_of_a_crowd_the_first_tell():
    positions = torch.zeros(5000, 3)
    positions[:9, 0] = torch.arange(9)
    values = torch.linspace(0, 1, 5000)[:, None]
    values[0] = values[1] = torch.nan
    found = with_neighbours_values(positions, values)
    torch.testing.assert_close(found[0], values[9:17].mean(dim=0))  # at the crowded place
    assert torch.equal(found[2:], values[2:])


@pytest.mark.parametrize("values", [torch.full((3, 1), torch.nan), torch.full((3, 1), 0.3)])
def test_all_or_none_have_a_value(values):
    found = with_neighbours_values(torch.rand(3, 3), values)
    assert torch.equal(found, values) or found.isnan().all()
