from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

from mrgs.data import load_scene
from mrgs.data.undistort import resize
from mrgs.errors import ConfigError
from mrgs.method.camera_model.point_spread import PointSpread
from mrgs.method.config import make_config
from mrgs.method.losses.term import LossContext, Term
from mrgs.scene import RGB, THERMAL, Camera, Pixels, PosedImage, View
from mrgs.training import train
from mrgs.training.start import TrainOptions
from mrgs.training.view_pass import SMALLEST_PX, coarse_size, coarser, pixel_sizes
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.training import short_config


def view(width: int = 330, height: int = 322):
    camera = Camera.from_fov(width, height, 60.0)
    values = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    return camera, Pixels(values)


def test_a_pixel_size_of_one_changes_nothing():
    camera, photo = view()
    cameras, photos = coarser({RGB: camera}, {RGB: photo}, 1)
    assert cameras[RGB] is camera
    assert photos[RGB] is photo


def test_the_photo_is_reduced_as_by_the_option_resolution():
    camera, photo = view()
    cameras, photos = coarser({RGB: camera}, {RGB: photo}, 2)
    assert (cameras[RGB].width, cameras[RGB].height) == (165, 161)
    assert torch.equal(photos[RGB].values, resize(photo.values, None, 165, 161)[0])
    assert photos[RGB].valid is None


def test_the_coarse_camera_sees_the_same_frame():
    camera, photo = view(width=331)
    cameras, photos = coarser({RGB: camera}, {RGB: photo}, 2)
    assert photos[RGB].values.shape == (161, 165, 3)
    corner = torch.tensor([331.0, 322.0])
    point = camera.unproject(corner, torch.tensor(2.0))
    seen, _ = cameras[RGB].project(point[None].float())
    torch.testing.assert_close(seen[0], torch.tensor([165.0, 161.0]), rtol=1e-5, atol=0)
    assert pixel_sizes({RGB: camera}, cameras) == {RGB: 331 / 165}


def test_a_coarse_pixel_counts_where_all_that_it_covers_do():
    camera, photo = view()
    valid = torch.ones(322, 330, dtype=torch.bool)
    valid[5, 7] = False
    _, photos = coarser({THERMAL: camera}, {THERMAL: Pixels(photo.values[..., :1], valid)}, 2)
    assert not photos[THERMAL].valid[2, 3]
    assert photos[THERMAL].valid.sum() >= 161 * 165 - 9


def test_small_images_get_smaller_pixels():
    camera, photo = view(660, 1288)
    middle, middle_photo = view()
    small, small_photo = view(200, 300)
    cameras, photos = coarser(
        {RGB: camera, THERMAL: middle, NEAR_INFRARED: small},
        {RGB: photo, THERMAL: middle_photo, NEAR_INFRARED: small_photo},
        4,
    )
    assert photos[RGB].values.shape == (322, 165, 3)
    assert photos[THERMAL].values.shape == (161, 165, 3)
    assert cameras[NEAR_INFRARED] is small
    assert photos[NEAR_INFRARED].values is small_photo.values
    sizes = pixel_sizes({RGB: camera, THERMAL: middle, NEAR_INFRARED: small}, cameras)
    assert sizes == {RGB: 4.0, THERMAL: 2.0, NEAR_INFRARED: 1.0}


@pytest.mark.parametrize("size", [(640, 200), (200, 640)])
def test_the_shorter_side_decides_how_large_pixels_may_be(size):
    assert coarse_size(*size, 4) == size
    assert coarse_size(*(2 * each for each in size), 4) == size


class Widths(Term):
    """Notes how wide the images of each step are, and has nothing to say."""

    name = "widths"

    def __init__(self) -> None:
        self.seen: dict[int, list[int]] = {}
        self._step = 0

    def is_due(self, step: int) -> bool:
        self._step = step
        return True

    def value(self, context: LossContext) -> None:
        self.seen[self._step] = [photo.values.shape[1] for photo in context.photos.values()]


def test_a_training_begins_on_coarse_photos_and_resumes_there(small_scene, tmp_path):
    size = 4 * SMALLEST_PX
    loaded = load_scene(small_scene)
    views = []
    for view in loaded.train:
        camera, photo = view.images[THERMAL].camera.resized(size, size), view.images[THERMAL].load()
        values = Pixels(resize(photo.values.repeat(22, 16, 1), None, size, size)[0])
        views.append(View(view.name, {THERMAL: PosedImage(camera, lambda values=values: values)}))
    scene, widths = replace(loaded, train=tuple(views), eval=()), Widths()
    config = replace(short_config(max_steps=6), coarse_until=0.7)
    whole = train(scene, tmp_path / "whole", config, terms=[widths])
    del widths.seen[0]  # before the first step the kernels were checked
    assert list(widths.seen.values()) == [[160]] * 2 + [[320]] * 2 + [[640]] * 2
    train(scene, tmp_path / "parts", config, terms=[widths], stop_at=2)
    parts = train(
        scene, tmp_path / "parts", config, options=TrainOptions(resume=True), terms=[widths]
    )
    expected, found = (load_file(run.newest_checkpoint()) for run in (whole, parts))
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_the_point_spread_is_that_of_the_photos():
    spread = PointSpread()
    image = torch.rand(40, 50, 1, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        spread.log_sigma.fill_(math.log(1.6))
        coarse = spread(image, 2.0)
        spread.log_sigma.fill_(math.log(0.8))
        torch.testing.assert_close(coarse, spread(image))


def test_only_the_presets_for_cpus_begin_coarse():
    sizes = [
        make_config("mrgs", preset="fast").pixel_size_at(step) for step in (1, 374, 375, 749, 750)
    ]
    assert sizes == [4, 4, 2, 2, 1]
    assert make_config("mrgs", preset="paper").pixel_size_at(1) == 1
    with pytest.raises(ConfigError, match="coarse_until"):
        replace(make_config("mrgs"), coarse_until=1.5)
