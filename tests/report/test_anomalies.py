from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.marks import Mark
from mrgs.marks.measure import MarkReading
from mrgs.marks.uncertainty import Uncertainty
from mrgs.rasterizer.contract import Dilation
from mrgs.report.anomalies import Anomaly, Spot, _apart, _Cube, _Sightings, find_spots
from mrgs.runs.baked import BakedModel
from mrgs.scene import (
    RGB,
    THERMAL,
    Camera,
    Pixels,
    PosedImage,
    Rendering,
    SceneBounds,
    TemperatureRange,
    View,
)
from mrgs.scene.depth_map import DepthMap

HOT, COLD = (0.3, 0.2), (-0.35, -0.1)
"""Places on the plane z = 0."""

WARM = 0.5
SHEET = [((0.02 * x, 0.02 * y, 0.3), 1.0) for x in range(-8, 9) for y in range(-8, 9)]


def camera_at(angle: float) -> Camera:
    position = torch.tensor(
        [1.2 * math.cos(angle), 1.2 * math.sin(angle), 2.0], dtype=torch.float64
    )
    forward = -position / position.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = right / right.norm()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    K = torch.tensor([[150.0, 0, 80.0], [0, 150.0, 60.0], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, viewmat, 160, 120)


def views(count: int = 8, thermal: bool = True) -> list[View]:
    cameras = [camera_at(2 * math.pi * i / count) for i in range(count)]
    images = [PosedImage(camera, lambda: Pixels(torch.zeros(120, 160, 1))) for camera in cameras]
    return [
        View(f"view_{i}", {THERMAL if thermal else RGB: image}) for i, image in enumerate(images)
    ]


def plane(extra: list[tuple[tuple[float, float, float], float]] = []) -> BakedModel:  # noqa: B006
    """An opaque plane of 81 × 81 flat splats with a hot and a cold patch, and extra balls (place,
    temperature)."""
    grid = torch.linspace(-0.8, 0.8, 81)
    x, y = (axis.flatten() for axis in torch.meshgrid(grid, grid, indexing="ij"))
    means = torch.stack([x, y, torch.zeros_like(x)], dim=1)
    temperatures = torch.full_like(x, WARM)
    for (centre_x, centre_y), value in ((HOT, 0.9), (COLD, 0.1)):
        temperatures[(x - centre_x) ** 2 + (y - centre_y) ** 2 < 0.1**2] = value
    scales = torch.tensor([0.02, 0.02, 0.001]).expand(len(x), 3)
    for place, value in extra:
        means = torch.cat([means, torch.tensor([place])])
        temperatures = torch.cat([temperatures, torch.tensor([value])])
        scales = torch.cat([scales, torch.full((1, 3), 0.03)])
    n = len(means)
    opacity, quats = torch.full((n,), 0.98), torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    return BakedModel(
        means,
        quats,
        scales,
        {RGB: opacity, THERMAL: opacity},
        {RGB: torch.zeros(n, 1, 3)},
        {RGB: torch.zeros(n, 15, 3)},
        temperatures,
        TemperatureRange(0.0, 100.0),
        dilation=Dilation(),
    )


def test_the_known_extremes_are_found():
    hottest, coldest = find_spots(views(), plane().render)
    for spot, place, value in ((hottest[0], HOT, 0.9), (coldest[0], COLD, 0.1)):
        assert spot.value == pytest.approx(value, abs=0.01)
        assert np.hypot(*(spot.position[:2] - place)) < 0.1
        assert abs(spot.position[2]) < 0.02
        assert spot.low <= spot.value <= spot.high
        assert spot.high - spot.low < 0.02
        assert spot.views >= 6


def test_a_spot_lies_where_its_view_shows_its_value():
    """Not between the places of several views, beside which a narrow thing may lie."""
    places = np.array([[0.0, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.01, 0.0, 0.01]])
    values, views = np.array([0.88, 0.9, 0.89]), np.arange(3)
    sightings = _Sightings(np.zeros(3, int), views, values, places, np.array([5, 9, 4]))
    images = {}
    for view in range(3):
        camera = camera_at(2.0 * view)
        column, row = camera.project(torch.from_numpy(places[view]))[0].int().tolist()
        image = np.full((120, 160), WARM)
        image[row - 1 : row + 2, column - 1 : column + 2] = 0.9
        images[view] = DepthMap(camera, np.full((120, 160), 2.3), image[..., None])
    cube = _Cube(0.89, values[[0, 2, 1]], np.array([0, 2, 1]))
    (spot,) = _apart([cube], 1, sightings, images, 1, 0.1, [])
    assert (spot.view, spot.value) == (1, 0.89)
    assert np.array_equal(spot.position, places[1])


def test_what_lies_far_behind_the_scene_is_no_spot():
    ball = SceneBounds(torch.tensor([*HOT, 0.0]).double(), 0.11)
    hottest, coldest = find_spots(views(), plane().render, ball=ball)
    assert hottest[0].value == pytest.approx(0.9, abs=0.01)
    assert all(spot.value > 0.4 for spot in coldest)
    for spot in (*hottest, *coldest):
        assert not ball.is_background(torch.from_numpy(spot.position))


def test_spots_of_a_list_keep_their_distance():
    hottest, _ = find_spots(views(), plane().render)
    assert [spot.value for spot in hottest] == sorted(
        (spot.value for spot in hottest), reverse=True
    )
    for i, spot in enumerate(hottest):
        assert all(np.linalg.norm(spot.position - other.position) > 0.15 for other in hottest[:i])


def test_a_floater_before_one_camera_does_not_count():
    first = views()[0].images[THERMAL].camera
    place = tuple((first.position + 0.4 * first.forward).float().tolist())
    model = plane([(place, 1.0)])
    assert model.render(first)[THERMAL].image.max() > 0.95
    hottest, _ = find_spots(views(), model.render)
    assert hottest[0].value == pytest.approx(0.9, abs=0.01)
    assert np.hypot(*(hottest[0].position[:2] - HOT)) < 0.1


def test_the_view_that_is_named_sees_the_spot():
    all_views = views()
    hottest, _ = find_spots(all_views, plane().render)
    camera = all_views[hottest[0].view].images[THERMAL].camera
    pixel, depth = camera.project(torch.from_numpy(hottest[0].position))
    column, row = pixel.int().tolist()
    rendering = plane().render(camera)
    assert rendering[THERMAL].image[row, column, 0].item() == pytest.approx(0.9, abs=0.01)
    assert rendering[THERMAL].depth[row, column].item() == pytest.approx(depth.item(), rel=0.02)


def test_two_views_are_enough_where_there_are_no_more():
    hottest, _ = find_spots(views(2), plane().render)
    assert hottest[0].views == 2


def test_nothing_is_found_where_nothing_is_seen():
    assert find_spots(views(), BakedModel(
        torch.tensor([[0.0, 0.0, 50.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.01),
        {THERMAL: torch.tensor([0.5])}, {}, {}, torch.tensor([0.5]), None,
        dilation=Dilation(),
    ).render) == ([], [])  # fmt: skip
    assert find_spots(views(thermal=False), plane().render) == ([], [])


def test_what_was_judged_is_not_found_again():
    judged = [np.array([[*HOT, 0.0]]), np.array([[*COLD, 0.0]])]
    assert find_spots(views(), plane().render, judged=judged[:1])[0] == []
    assert find_spots(views(), plane().render, judged=judged) == ([], [])


def found_with_mist(
    sheet: list[tuple[tuple[float, float, float], float]],
) -> tuple[list[Spot], list[Spot]]:
    """Of the plane; three of twelve views see a sheet before it, which for the others is
    transparent."""
    all_views = views(12)

    def render(camera: Camera) -> Rendering:
        here = [torch.allclose(camera.viewmat, each.images[THERMAL].camera.viewmat)
                for each in all_views[:3]]  # fmt: skip
        return (plane(sheet) if any(here) else plane()).render(camera)

    return find_spots(all_views, render)


def test_mist_that_most_views_look_through_is_no_spot():
    hottest, _ = found_with_mist(SHEET)
    assert hottest[0].value == pytest.approx(0.9, abs=0.01)


def test_part_of_something_large_and_cold_is_no_spot():
    """As the sky about a roof: a third of the picture is colder than the cold patch."""
    model = plane()
    means, scales = model.means * torch.tensor([2.5, 2.5, 1.0]), model.scales * 2.5
    temperatures = torch.where(means[:, 0] > 0.8, 0.02, model.temperatures)
    model = replace(model, means=means, scales=scales, temperatures=temperatures)
    _, coldest = find_spots(views(), model.render)
    assert coldest[0].value == pytest.approx(0.1, abs=0.02)
    assert np.hypot(*(coldest[0].position[:2] - 2.5 * np.array(COLD))) < 0.3


def test_mist_before_nothing_is_no_spot():
    """Beyond the plane's edge, where the other views see no surface."""
    sheet = [((x + 1.2, y, z), value) for (x, y, z), value in SHEET]
    hottest, _ = found_with_mist(sheet)
    assert hottest[0].value == pytest.approx(0.9, abs=0.01)


def test_something_large_within_the_picture_is_a_spot():
    """It takes up more than a twentieth of the pictures, but reaches no border: no sky."""
    model = plane()
    centre = torch.tensor([-0.1, 0.1])
    near = (model.means[:, :2] - centre).norm(dim=1) < 0.38
    model = replace(model, temperatures=torch.where(near, 1.0, model.temperatures))
    seen = model.render(views()[0].images[THERMAL].camera)[THERMAL].image
    assert (seen > 0.95).double().mean() > 0.05
    hottest, _ = find_spots(views(), model.render)
    assert hottest[0].value == pytest.approx(1.0, abs=0.01)
    assert np.linalg.norm(hottest[0].position[:2] - centre.numpy()) < 0.4


@pytest.mark.parametrize(
    ("uncertainty", "stands_out"),
    [(None, True), (Uncertainty(0.09), True), (Uncertainty(0.11), False), (Uncertainty(), True)],
)
def test_a_place_is_held_back_by_an_uncertainty_of_more_than_a_tenth(uncertainty, stands_out):
    spot = Spot(np.zeros(3), 0.4, 0.39, 0.41, 8, 0)
    mark = Mark("?", "spot", ((0.0, 0.0, 0.0),), (0.0, 0.0, 2.0), 0.1)
    reading = MarkReading(mark, uncertainty=uncertainty)
    assert Anomaly(spot, reading, -1.0).stands_out == stands_out
    if uncertainty is not None and uncertainty.known:
        assert not Anomaly(spot, replace(reading, uncertainty=Uncertainty(5.1)), 80.0).stands_out
        assert Anomaly(spot, replace(reading, uncertainty=Uncertainty(4.9)), 80.0).stands_out


def test_an_object_has_one_proposal_far_from_its_edge():
    model = plane()
    x, y = model.means[:, :2].T
    bar = (x.abs() < 0.55) & ((y - 0.5).abs() < 0.12)
    warm = torch.where(bar, 0.9, WARM)
    corner = bar & (x > 0.5) & (y > 0.56)
    model = replace(model, temperatures=torch.where(corner, 0.92, warm))
    hottest, _ = find_spots(views(), model.render)
    (spot,) = (spot for spot in hottest if spot.position[1] > 0.35)
    assert spot.value == pytest.approx(0.9, abs=0.005)
    assert abs(spot.position[1] - 0.5) < 0.06
    assert abs(spot.position[0]) < 0.5
