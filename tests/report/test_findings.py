"""The pictures of a mark: which view they are from, and which part of it they show."""

from __future__ import annotations

import base64
import io
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.marks import Mark, MarkReading
from mrgs.method.camera_model.image_model import ImageModel, ImageModelConfig
from mrgs.method.start.overlap import find_from_overlap
from mrgs.pictures.drawing import COLDEST, HOTTEST
from mrgs.pictures.html import InlineImage
from mrgs.report.findings import (
    LEAST_SHARE,
    MARK_SHARE,
    WIDTH_PX,
    _about,
    camera_effects,
    mark_pictures,
    nearest_view,
)
from mrgs.report.texts import Texts
from mrgs.scene import RGB, THERMAL, Camera, Rendering, Scene
from mrgs.scene.capture import Capture
from mrgs.scene.rendering import Blend
from tests.helpers.drifting import drifting_scene

THERMAL_CAMERA = Camera.from_fov(80, 60, 50)
PHOTO_CAMERA = Camera.from_fov(200, 150, 70)
EYES = [(-1.5, -6.0, 0.0), (0.0, -6.0, 0.0), (1.5, -6.0, 0.0)]


def scene(photo: torch.Tensor | None = None) -> Scene:
    """Three views of the plane y = 0, with an RGB camera beside the thermal one."""
    photo = torch.full((150, 200, 3), 0.5) if photo is None else photo
    return Scene.from_arrays(
        [PHOTO_CAMERA.look_at((x + 0.4, y, z), (x, 0, z)) for x, y, z in EYES],
        rgb=[photo] * 3,
        celsius=[torch.linspace(10, 30, 80).expand(60, 80)] * 3,
        thermal_cameras=[THERMAL_CAMERA.look_at(eye, (eye[0], 0, eye[2])) for eye in EYES],
        points=torch.rand(50, 3),
        eval_every=0,
    )


def line(start: tuple[float, float], end: tuple[float, float], eye=EYES[1]) -> Mark:
    """On the plane, from x, z to x, z."""
    return Mark("L1", "line", ((start[0], 0.0, start[1]), (end[0], 0.0, end[1])), eye)


def test_the_view_is_that_from_nearest_to_where_the_mark_was_drawn():
    made = scene()
    for view, (x, y, z) in zip(made.train, EYES, strict=True):
        mark = line((-0.5, 0.0), (0.5, 0.2), eye=(x + 0.2, y, z))
        assert nearest_view(mark, made) is view


def test_a_view_that_does_not_see_all_of_a_mark_is_passed_over():
    made = scene()
    reach = THERMAL_CAMERA.width / 2 / THERMAL_CAMERA.focal_px * 6
    beyond = line((0.0, 0.0), (reach + 0.5, 0.0), eye=EYES[0])
    assert nearest_view(beyond, made) is made.train[2]
    assert nearest_view(line((-9.0, 0.0), (9.0, 0.0)), made) is None


@pytest.mark.parametrize(
    "mark",
    [
        line((-0.2, -0.1), (0.3, 0.1)),
        line((-1.2, -0.9), (1.0, 0.5)),
        line((2.2, 1.5), (2.5, 1.7)),
        line((-2.6, 1.4), (-2.5, -1.9)),
        line((-2.7, -2.0), (2.7, 2.0)),
    ],
)
def test_a_picture_shows_all_of_a_mark_large_and_nothing_beyond_the_photo(mark):
    camera = scene().train[1].images[THERMAL].camera
    part = _about(mark, camera)
    pixels, _ = part.project(torch.tensor(mark.points).double())
    assert part.contains(pixels).all()
    assert (part.width, part.height) == (WIDTH_PX, round(WIDTH_PX * 60 / 80))
    corners = torch.tensor([[0.0, 0.0], [part.width, part.height]]).double()
    (left, top), (right, bottom) = camera.project(part.unproject(corners, 1.0))[0].tolist()
    assert left >= -1e-9
    assert top >= -1e-9
    assert right <= 80 + 1e-9
    assert bottom <= 60 + 1e-9
    given, _ = camera.project(torch.tensor(mark.points).double())
    taken = ((given[1] - given[0]).abs() / given.new_tensor([80, 60])).max().item()
    assert (right - left) / 80 == pytest.approx(min(max(taken / MARK_SHARE, LEAST_SHARE), 1.0))


def test_a_mark_that_is_not_at_the_border_is_in_the_middle():
    camera = scene().train[1].images[THERMAL].camera
    mark = line((0.1, 0.5), (0.3, 0.7))
    middle = _about(mark, camera).project(torch.tensor(mark.points).double())[0].mean(dim=0)
    torch.testing.assert_close(middle, middle.new_tensor([WIDTH_PX / 2, WIDTH_PX * 3 / 8]))


class Even:
    """Renders a surface of one temperature."""

    def render(self, camera: Camera) -> Rendering:
        shape = camera.height, camera.width
        alpha = torch.ones(shape)
        return Rendering({THERMAL: Blend(torch.full((*shape, 1), 0.5), alpha, alpha)})


def decoded(picture: InlineImage) -> np.ndarray:
    content = base64.b64decode(str(picture.source).partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def place_of(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Column and row of a dot."""
    rows, columns = np.nonzero(np.abs(picture - color).max(axis=2) < 40)
    assert len(rows) > 40
    return np.array([np.median(columns), np.median(rows)]) + 0.5


def test_the_photo_shows_the_same_part_from_its_own_camera():
    """What is green in the photo at the coldest place of a mark lies below the dot there."""
    made = scene()
    view = made.train[1]
    mark = line((0.4, 0.3), (1.2, -0.4))
    pixels, _ = view.images[RGB].camera.project(torch.tensor(mark.points).double())
    photo = torch.full((150, 200, 3), 0.5)
    column, row = pixels[0].int().tolist()
    photo[row - 4 : row + 5, column - 4 : column + 5] = torch.tensor([0.0, 1.0, 0.0])
    reading = MarkReading(mark, 20.0, 19.0, 21.0, low_at=mark.points[0], high_at=mark.points[1])
    regions = SimpleNamespace(render=Even().render)
    thermal, seen = map(decoded, mark_pictures(reading, scene(photo).train[1], regions, made))
    part = _about(mark, view.images[THERMAL].camera)
    cold, _ = part.project(torch.tensor(mark.points[0]).double())
    assert place_of(thermal, COLDEST)[0] == pytest.approx(cold[0].item(), abs=2)
    part = _about(mark, view.images[RGB].camera)
    ends, _ = part.project(torch.tensor(mark.points).double())
    for end, color in zip(ends.numpy(), (COLDEST, HOTTEST), strict=True):
        np.testing.assert_allclose(place_of(seen, color), end, atol=2)
    rows, columns = np.nonzero((seen[:, :, 1] > 200) & (seen[:, :, 0] < 100))
    np.testing.assert_allclose([columns.mean(), rows.mean()], ends[0].numpy(), atol=6)


def test_a_view_without_a_photo_has_the_thermal_picture_alone():
    made = scene()
    view = replace(made.train[1], images={THERMAL: made.train[1].images[THERMAL]})
    reading = MarkReading(line((-0.2, -0.1), (0.3, 0.1)))
    assert len(mark_pictures(reading, view, SimpleNamespace(render=Even().render), made)) == 1


def test_offsets_over_time_and_the_shading_are_shown():
    scene = drifting_scene()
    config = ImageModelConfig(thermal_drift=True, thermal_shading=True)
    model = ImageModel(config, Capture.of(scene))
    find_from_overlap(scene, model, config)
    run = SimpleNamespace(image_model=model, temperature=scene.temperature)
    shown = camera_effects(run, Texts())
    assert shown.offsets.path.count("M") == 2, "a line before the pause, one after it"
    assert shown.offsets.path.count("L") == len(scene.train) - 2
    assert shown.offsets.low.startswith("−4")
    assert shown.offsets.end == "13 min"
    picture = Image.open(io.BytesIO(base64.b64decode(shown.shading.source.partition(",")[2])))
    corner, middle = picture.getpixel((3, 3)), picture.getpixel((160, 120))
    assert corner[2] > corner[0], "colder: blue"
    assert middle[0] > middle[2], "warmer: red"
    assert shown.shift == ""
    model.constant += 0.1
    assert camera_effects(run, Texts()).shift.startswith("+")
    nothing = SimpleNamespace(
        image_model=ImageModel(ImageModelConfig(), Capture.of(scene)), temperature=run.temperature
    )
    assert camera_effects(nothing, Texts()) is None
