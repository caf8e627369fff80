"""Where a plan of the marks shows them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Bool
from PIL import Image

from mrgs.marks import Mark
from mrgs.pictures.drawing import INK
from mrgs.report.overview import HEIGHT_PX, MARGIN_PX, MARK, WIDTH_PX, Plan, faces_one_side
from mrgs.scene import Camera, PointCloud, Scene, WorldFrame

CAMERA = Camera.from_fov(16, 12, 60)
AROUND = [
    CAMERA.look_at((8 * math.cos(a), 8 * math.sin(a), 2), (0, 0, 0))
    for a in np.linspace(0, 2 * math.pi, 8, endpoint=False)
]
FROM_THE_SOUTH = [CAMERA.look_at((x, -8, 1), (x, 0, 1)) for x in (-2, 0, 2)]
FROM_THE_AIR = [CAMERA.look_at((x, 0, 9), (x, 0, 0), up=(0, 1, 0)) for x in (-2, 0, 2)]
BODY = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 8 - 4
"""Points in a cube whose sides are 8 long."""


def scene_of(
    cameras: Sequence[Camera], points: torch.Tensor = BODY, world: WorldFrame | None = None
) -> Scene:
    made = Scene.from_arrays(
        cameras, rgb=torch.full((len(cameras), 12, 16, 3), 0.5), points=points, eval_every=0
    )
    return replace(made, world=world or WorldFrame())


def spot(name: str, *place: float) -> Mark:
    return Mark(name, "spot", (place,), (0.0, -8.0, 1.0), radius=0.1)


def pixels_of(image: Image.Image, color: tuple[int, int, int]) -> Bool[np.ndarray, "h w"]:
    apart = np.asarray(image.convert("RGB")).astype(int) - color
    found: Bool[np.ndarray, "h w"] = np.abs(apart).max(axis=2) < 12
    return found


def middle(plan: Plan, mark: Mark) -> tuple[float, float]:
    """Column and row of a mark in its small plan."""
    rows, columns = np.nonzero(pixels_of(plan.small(mark), MARK))
    assert len(rows) > 20
    return float(columns.mean()), float(rows.mean())


def test_from_above_east_is_right_and_north_is_up():
    marks = [spot("W", -3, 0, 0), spot("E", 3, 0, 0), spot("N", 0, 3, 2)]
    plan = Plan(scene_of(AROUND), marks)
    west, east, north = (middle(plan, mark) for mark in marks)
    assert not plan.from_the_front
    assert east[0] - west[0] == pytest.approx(2 * (west[1] - north[1]), abs=2)
    assert north[0] == pytest.approx((east[0] + west[0]) / 2, abs=2)
    assert west[1] == pytest.approx(east[1], abs=2)
    assert east[0] - west[0] > 20


def test_from_the_front_it_is_as_the_cameras_see_it():
    marks = [spot("left", -3, 0, 0), spot("right", 3, 1, 0), spot("top", 0, -1, 3)]
    plan = Plan(scene_of(FROM_THE_SOUTH), marks)
    left, right, top = (middle(plan, mark) for mark in marks)
    assert plan.from_the_front
    assert right[0] - left[0] == pytest.approx(2 * (left[1] - top[1]), abs=2)
    assert right[0] - left[0] > 20


@pytest.mark.parametrize(
    ("cameras", "expected"),
    [(AROUND, False), (AROUND[:5], False), (FROM_THE_SOUTH, True), (FROM_THE_AIR, False)],
)
def test_only_what_is_seen_from_one_side_is_drawn_from_the_front(cameras, expected):
    assert faces_one_side(scene_of(cameras)) is expected


@pytest.mark.parametrize(("cameras", "axis", "near"), [(AROUND, 2, 3.0), (FROM_THE_SOUTH, 1, -3.0)])
def test_what_is_nearer_to_the_onlooker_covers_what_is_behind(cameras, axis, near):
    across = torch.linspace(-4, 4, 60)
    sheet = torch.stack(torch.meshgrid(across, across, indexing="ij"), dim=2).flatten(0, 1)
    columns = [each for each in range(3) if each != axis]
    points, colors = torch.zeros(2, len(sheet), 3), torch.zeros(2, len(sheet), 3)
    points[:, :, columns] = sheet
    points[0, :, axis], points[1, :, axis] = near, -near
    colors[0, :, 0] = colors[1, :, 1] = 1
    scene = scene_of(cameras)
    sheets = PointCloud(points.flatten(0, 1), colors.flatten(0, 1))
    red, green, _ = np.asarray(Plan(replace(scene, points=sheets), []).whole({})).astype(int).T
    assert (red > green + 60).sum() > 20 * max((green > red + 60).sum(), 1000)


@pytest.mark.parametrize("far", [(60.0, 0.0, 0.0), (0.0, 60.0, 0.0), (0.0, 0.0, -60.0)])
@pytest.mark.parametrize("cameras", [AROUND, FROM_THE_SOUTH])
def test_every_mark_is_on_the_plan_however_far_it_lies(cameras, far):
    marks = [spot("near", 0, 0, 0), spot("far", *far)]
    plan = Plan(scene_of(cameras), marks)
    places = [middle(plan, mark) for mark in marks]
    size = plan.small(marks[0]).size
    assert all(0 < x < size[0] and 0 < y < size[1] for x, y in places)
    image = plan.whole({})
    assert image.width == WIDTH_PX
    assert image.height <= HEIGHT_PX + 1


def test_from_above_all_cameras_are_on_the_plan():
    far = [*AROUND, CAMERA.look_at((90.0, 0.0, 2.0), (0, 0, 0))]
    blue = pixels_of(Plan(scene_of(far), []).whole({}), (31, 95, 168))
    assert np.nonzero(blue)[1].max() > WIDTH_PX - 2 * MARGIN_PX


def test_a_bar_of_a_round_length_is_drawn_where_lengths_are_known():
    marks = [spot("W", -3, 0, 0), spot("E", 3, 0, 0)]
    known = scene_of(AROUND, world=WorldFrame(metric=True))
    plan = Plan(known, marks)
    image = plan.whole({})
    left, right = np.flatnonzero(pixels_of(image, INK)[-MARGIN_PX, : WIDTH_PX // 2])[[0, -1]]
    west, east = (middle(plan, mark)[0] for mark in marks)
    metres = 6 * (right - left) / ((east - west) * max(image.size) / max(plan.small(marks[0]).size))
    assert any(metres == pytest.approx(length, rel=0.05) for length in (1, 2, 4))
    unknown = Plan(scene_of(AROUND), marks).whole({})
    assert not pixels_of(unknown, INK)[-MARGIN_PX:].any()


@pytest.mark.parametrize(("cameras", "has_arrow"), [(AROUND, True), (FROM_THE_SOUTH, False)])
def test_an_arrow_shows_north_on_a_plan_from_above(cameras, has_arrow):
    corner = slice(0, 2 * MARGIN_PX), slice(WIDTH_PX - 2 * MARGIN_PX, WIDTH_PX)
    for north in (True, False):
        scene = scene_of(cameras, world=WorldFrame(metric=True, north=north))
        assert pixels_of(Plan(scene, []).whole({}), INK)[corner].any() == (has_arrow and north)
