"""How many cameras of a long capture are needed to see every place of it."""

import numpy as np
import pytest
import torch

from mrgs import Camera, Scene
from mrgs.scene import THERMAL, Blend, Rendering
from mrgs.scene.depth_map import ALWAYS, ENOUGH, PhotoSurvey, surveying, visible


def flight(lines: int, photos: int, apart: float) -> list[Camera]:
    """Cameras that look down from a height of 10 on lines, photos of a line half as far apart."""
    lens = Camera.from_fov(64, 48, 40.0)
    return [
        lens.look_at([x, y, 10.0], [x, y, 0.0], up=[0.0, 1.0, 0.0])
        for y in apart * np.arange(lines)
        for x in 0.5 * apart * np.arange(photos)
    ]


def ground(width: float, height: float) -> np.ndarray:
    low, size = np.array([1.0, 1.0, 0.0]), np.array([width - 2, height - 2, 0.0])
    return (low + size * np.random.default_rng(0).random((4000, 3))).astype(np.float32)


def flat_rendering(camera: Camera) -> Rendering:
    """A plane at a distance of 10."""
    flat = torch.ones(camera.height, camera.width)
    return Rendering({THERMAL: Blend(flat[..., None], 10 * flat, flat)})


def test_every_place_of_a_long_flight_is_seen_often_enough_by_few_cameras():
    cameras, points = flight(20, 40, 2.0), ground(38.0, 38.0)
    chosen = surveying(cameras, points)
    every, counts = np.zeros((2, len(points)), int)
    for index, camera in enumerate(cameras):
        rows = visible(camera, points).rows
        every[rows] += 1
        counts[rows] += index in chosen
    assert chosen == sorted(set(chosen))
    assert len(chosen) < 0.5 * len(cameras)
    assert (counts >= np.minimum(every, 3)).mean() > 0.99
    assert (counts >= np.minimum(every, ENOUGH)).mean() > 0.9


@pytest.mark.parametrize("count", [1, 5, ALWAYS])
def test_all_cameras_of_a_short_capture_are_surveyed(count):
    cameras = flight(1, count, 2.0)
    assert surveying(cameras, ground(8.0, 8.0)) == list(range(count))


def test_without_points_the_cameras_are_spread_evenly():
    cameras = flight(1, 200, 2.0)
    chosen = surveying(cameras, np.zeros((0, 3), np.float32))
    assert len(chosen) == ALWAYS
    assert (chosen[0], chosen[-1]) == (0, 199)


def test_views_without_a_photo_of_the_modality_do_not_count():
    cameras, image = flight(1, 4, 2.0), np.zeros((48, 64), np.float32)
    celsius = [image, None, image, None]
    scene = Scene.from_arrays(cameras, rgb=np.zeros((4, 48, 64, 3)), celsius=celsius)
    assert len(scene.survey_views()) == len(scene.train)
    assert len(scene.survey_views(THERMAL)) == len(scene.train_photos(THERMAL)) < len(scene.train)


def test_only_cameras_that_may_see_a_point_are_rendered():
    drawn = []

    def render(camera: Camera) -> Rendering:
        drawn.append(camera)
        return flat_rendering(camera)

    cameras = flight(1, 40, 2.0)
    survey = PhotoSurvey(render, cameras)
    point = np.array([[20.0, 0.0, 0.0]], np.float32)
    assert not survey.made_near(point)
    assert survey.temperatures(point) == [1.0]
    assert len(drawn) == sum(len(visible(camera, point).rows) for camera in cameras) < 10
    assert survey.made_near(point)
    away = np.array([[0.0, 90.0, 0.0]], np.float32)
    assert np.isnan(survey.temperatures(away)).all()
    assert len(drawn) < 10


def test_cameras_are_near_if_they_have_a_point_in_their_image():
    rng, lens = np.random.default_rng(0), Camera.from_fov(64, 48, 40.0)
    eyes = 20 * rng.normal(size=(50, 3))
    cameras = [lens.look_at(eye, eye + rng.normal(size=3)) for eye in eyes]
    survey = PhotoSurvey(flat_rendering, cameras)
    for spread in (0.01, 1.0, 10.0, 100.0):
        points = (15 * rng.normal(size=3) + spread * rng.normal(size=(9, 3))).astype(np.float32)
        expected = [i for i, each in enumerate(cameras) if len(visible(each, points).rows)]
        assert [number for number, _ in survey.near(points)] == expected
    assert list(survey.near(np.zeros((0, 3), np.float32))) == []
    assert list(PhotoSurvey(flat_rendering, []).near(points)) == []
