"""Which views show the marks, and what photos and renderings say about a spot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.marks import Mark
from mrgs.report.anomalies import Spot, photo_value, surroundings
from mrgs.report.overview import (
    OVERVIEW_PX,
    Overview,
    Style,
    _thermal,
    overviews,
)
from mrgs.scene import THERMAL, Camera, Pixels, PosedImage, Rendering, Scene, View
from mrgs.scene.depth_map import ALWAYS, PhotoSurvey, SurfaceRenderer
from mrgs.scene.rendering import Blend

CAMERA = Camera.from_fov(80, 60, 50)


def before(x: float) -> Camera:
    """Sees the plane y = 0 for 2.7 to either side of x."""
    return CAMERA.look_at((x, -6.0, 0.0), (x, 0.0, 0.0))


def scene(places: Sequence[float]) -> Scene:
    cameras = [before(x) for x in places]
    return Scene.from_arrays(
        cameras,
        rgb=[torch.full((60, 80, 3), 0.5)] * len(cameras),
        celsius=[torch.linspace(10, 30, 80).expand(60, 80)] * len(cameras),
        points=torch.rand(50, 3) - 0.5,
        eval_every=0,
    )


def rendered(image: Float[Tensor, "h w"], depth: Float[Tensor, "h w"]) -> Rendering:
    """Where the depth is NaN there is no surface."""
    alpha = depth.isfinite().float()
    return Rendering({THERMAL: Blend(image[..., None], depth.nan_to_num(), alpha)})


def wall(y: float = 0.0) -> SurfaceRenderer:
    """Renders a plane that the cameras look at, or one before or behind it."""

    def render(camera: Camera) -> Rendering:
        shape = camera.height, camera.width
        return rendered(torch.full(shape, 0.5), torch.full(shape, y - camera.position[1].item()))

    return render


def shown_in(made: Scene, marks: dict[str, Mark], render: SurfaceRenderer) -> list[Overview]:
    survey = PhotoSurvey(render, made.survey_cameras(THERMAL))
    return overviews(made, marks, survey, render)


def spots(**places: float) -> dict[str, Mark]:
    """Spots on the plane y = 0 by their names, from their x."""
    return {
        name: Mark(name, "spot", ((x, 0.0, 0.4),), (x, -6.0, 0.0), radius=0.1)
        for name, x in places.items()
    }


def test_each_view_shows_the_marks_that_those_before_it_do_not():
    made = scene([0.0, 10.0, 12.0, 20.0, 30.0, 40.0])
    marks = spots(A=0.0, B=9.5, C=10.5, D=12.5, E=20.0, F=20.5, G=30.0, H=99.0)
    shown = shown_in(made, marks, wall())
    assert [each.seen for each in shown] == [["B", "C", "D"], ["E", "F"], ["A"]]
    assert [each.view for each in shown] == [made.train[index].name for index in (1, 3, 0)]


@pytest.mark.parametrize("y", [-1.0, 1.0])
def test_what_something_hides_and_what_floats_is_not_shown(y):
    assert shown_in(scene([0.0]), spots(A=0.0), wall(y)) == []


def test_views_from_all_over_a_long_capture_are_tried():
    count = 2 * ALWAYS
    made = scene([0.0] * (count - 2) + [10.0] * 2)
    (shown,) = shown_in(made, spots(A=10.0), wall())
    assert shown.view in {view.name for view in made.train[-2:]}


def test_marks_are_drawn_where_the_cameras_see_them():
    made = scene([0.0])
    marks = spots(A=1.2)
    (shown,) = shown_in(made, marks, wall())
    photo, thermal = (np.asarray(picture) for picture in shown.pictures)
    assert photo.shape[1] == OVERVIEW_PX
    pixel, _ = before(0.0).project(torch.tensor(marks["A"].points).double())
    x, y = (OVERVIEW_PX / 80 * pixel[0]).tolist()
    rows, columns = np.nonzero((photo == 0).all(axis=2))
    assert [columns.mean(), rows.mean()] == pytest.approx([x, y], abs=2)
    assert thermal.shape[0] > photo.shape[0]  # its scale is below it


def test_a_line_that_reaches_behind_the_camera_is_not_drawn():
    line = Mark("L", "line", ((0.0, -8.0, 0.4), (0.0, 8.0, 0.4)), (0.0, -6.0, 0.0))
    without, both = (
        np.asarray(shown_in(scene([0.0]), spots(A=1.2) | more, wall())[0].pictures[0])
        for more in ({}, {"L": line})
    )
    assert np.array_equal(both, without)


def test_the_colours_of_an_overview_are_used_up_by_surfaces():
    made, camera = scene([0.0]), before(0.0)
    image, depth = torch.linspace(0.5, 0.7, 80).repeat(60, 1), torch.full((60, 80), 6.0)
    image[:20], depth[:20] = 0.0, torch.nan  # the sky
    _, scale = _thermal(rendered(image, depth), camera, made, Style())
    assert (scale.low, scale.high) == (pytest.approx(20, abs=0.6), pytest.approx(24, abs=0.6))


def photographed(values: Float[Tensor, "h w"], valid: Bool[Tensor, "h w"] | None = None) -> View:
    pixels = Pixels(values[..., None], valid)
    return View("view", {THERMAL: PosedImage(before(0.0), lambda: pixels)})


def spot_at(column: float, row: float) -> Spot:
    position = before(0.0).unproject(torch.tensor([column, row]).double(), 6.0).numpy()
    return Spot(position, 0.25, 0.2, 0.3, 5, 0)


VALUES = torch.rand(60, 80, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("column", "row", "expected"),
    [
        (50.5, 20.5, VALUES[19:22, 49:52]),
        (70.5, 5.5, VALUES[4:7, 69:72]),
        (0.5, 30.5, VALUES[29:32, :2]),
        (79.5, 59.5, VALUES[58:, 78:]),
    ],
)
def test_a_photo_is_read_in_three_by_three_pixels(column, row, expected):
    found = photo_value(photographed(VALUES), spot_at(column, row))
    assert found == pytest.approx(expected.mean().item(), rel=1e-5)


def test_pixels_of_a_photo_that_are_not_valid_are_not_read():
    valid = torch.ones(60, 80, dtype=torch.bool)
    valid[:, 50:] = False
    found = photo_value(photographed(VALUES, valid), spot_at(50.5, 20.5))
    assert found == pytest.approx(VALUES[19:22, 49].mean().item(), rel=1e-5)
    assert photo_value(photographed(VALUES, valid), spot_at(60.5, 20.5)) is None


def test_the_surroundings_of_a_spot_are_what_shows_a_surface_about_it():
    view, spot = photographed(VALUES), spot_at(40.5, 30.5)
    image, depth = torch.full((60, 80), 0.5), torch.full((60, 80), 6.0)
    image[:, 38:], depth[:, 38:] = 0.0, torch.nan  # the sky
    image[29:32, 35:38] = 0.9
    assert surroundings(view, spot, rendered(image, depth)) == pytest.approx(0.5)
    nowhere = torch.full((60, 80), torch.nan)
    assert surroundings(view, spot, rendered(image, nowhere)) == spot.value
