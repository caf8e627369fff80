"""Depths that photos agree on, before a textured wall that the model has in the wrong place."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.marks.measure import MarkMeter
from mrgs.marks.run_marks import MarkPicker
from mrgs.marks.stereo import PhotoStereo
from mrgs.marks.surface import see
from mrgs.scene import RGB, THERMAL, Blend, Camera, Pixels, PosedImage, Rendering, View
from mrgs.scene.depth_map import PhotoSurvey
from tests.helpers.walls import camera_before_wall, render_wall

PIXEL = (70.0, 50.0)
TOO_FAR = 1.012


def texture(points: torch.Tensor) -> torch.Tensor:
    """Colours of points of the wall [..., 3], from 0 to 1: waves of some decimetres."""
    x, z = points[..., 0:1], points[..., 2:3]
    waves = [
        torch.sin(a * x + b * z + c)
        for a, b, c in ((9, 4, 0), (-5, 11, 1), (14, -7, 2), (3, 16, 3))
    ]
    return (0.5 + 0.1 * sum(waves, torch.zeros(1))).expand(*points.shape[:-1], 3)


def photo_of_wall(camera: Camera, exposure: float, textured: bool) -> PosedImage:
    grid = camera.unproject_image(torch.ones(camera.height, camera.width).double())
    ray = grid - camera.position
    points = camera.position - camera.position[1] / ray[..., 1:2] * ray
    values = texture(points) if textured else torch.full((*points.shape[:-1], 3), 0.5)
    pixels = Pixels((exposure + values).float())
    return PosedImage(camera, lambda: pixels)


def render_too_far(camera: Camera) -> Rendering:
    """The wall 1.2 % farther away than it is."""
    image, depth, alpha = render_wall(camera)[THERMAL]
    return Rendering({THERMAL: Blend(image, TOO_FAR * depth, alpha)})


def stereo(xs: tuple[float, ...], textured: bool = True) -> PhotoStereo:
    cameras = [camera_before_wall(x) for x in xs]
    views = [
        View(
            f"{number}",
            {
                RGB: photo_of_wall(camera, 0.02 * number, textured),
                THERMAL: photo_of_wall(camera, 0.0, textured=False),
            },
        )
        for number, camera in enumerate(cameras)
    ]
    return PhotoStereo(PhotoSurvey(render_too_far, cameras), views)


def test_a_place_is_where_the_photos_agree():
    camera = camera_before_wall(1.0, distance=4.5)
    picker = MarkPicker(MarkMeter(render_too_far, None), None)
    (by_model,) = picker.pick("spot", camera, [PIXEL])["points"]
    picker._stereo = stereo((-2.0, -0.7, 0.8, 2.2))
    (by_photos,) = picker.pick("spot", camera, [PIXEL])["points"]
    assert by_model[1] == pytest.approx(-0.012 * -4.5, rel=0.02)
    assert abs(by_photos[1]) < 0.003
    pixel, _ = camera.project(torch.tensor(by_photos).double())
    assert pixel.tolist() == pytest.approx(PIXEL, abs=1e-6)


@pytest.mark.parametrize(("xs", "textured"), [((-2.0, 2.0), True), ((-2.0, -0.7, 0.8, 2.2), False)])
def test_with_few_photos_or_without_texture_it_is_where_the_model_has_it(xs, textured):
    camera = camera_before_wall()
    depth = float(see(render_too_far, camera).depth[50, 70])
    assert stereo(xs, textured).depth(camera, *PIXEL, depth) == pytest.approx(depth, rel=1e-6)


def test_a_photo_that_shows_something_else_does_not_count():
    found = stereo((-2.0, -1.0, 0.0, 1.0, 2.0))
    view = found._views[2]
    upside_down = Pixels(view.images[RGB].load().values.flip(0, 1))
    found._views[2] = View(
        view.name, {**view.images, RGB: PosedImage(view.images[RGB].camera, lambda: upside_down)}
    )
    camera = camera_before_wall(0.5)
    exact = float(see(render_wall, camera).depth[50, 70])
    depth = found.depth(camera, 70.5, 50.5, TOO_FAR * exact)
    assert np.abs(depth / exact - 1) < 0.001
