from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.scene import RGB, THERMAL, Pixels, PosedImage, View
from mrgs_thermonerf.rays import PixelPool, frame_of
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.scenes import write_scene


def drawn(scene, count=64, seed=0):
    return PixelPool(scene, frame_of(scene)).draw(count, torch.Generator().manual_seed(seed))


def test_one_ray_serves_both_modalities_of_a_shared_camera(small_scene):
    scene = load_scene(small_scene)
    batch = drawn(scene)
    assert batch.rays.origins.shape == (64, 3)
    assert (batch.targets[RGB].rows, batch.targets[THERMAL].rows) == (slice(0, 64), slice(0, 64))
    assert (batch.targets[RGB].values.shape, batch.targets[THERMAL].values.shape) == (
        (64, 3),
        (64, 1),
    )
    assert batch.targets[RGB].valid is None


def test_a_scene_without_either_is_refused(small_scene):
    scene = load_scene(small_scene)
    views = [View(view.name, {NEAR_INFRARED: view.images[THERMAL]}) for view in scene.train]
    with pytest.raises(SceneError, match="neither RGB nor"):
        drawn(replace(scene, train=tuple(views), eval=()))


def test_values_are_those_of_the_pixels_that_the_rays_pass_through(small_scene):
    scene = load_scene(small_scene)
    frame = frame_of(scene)
    batch = drawn(scene)
    cameras = [view.images[RGB].camera for view in scene.train]
    origins = torch.stack([frame.normalised(camera.position).float() for camera in cameras])
    for ray in range(64):
        image = int((origins - batch.rays.origins[ray]).norm(dim=1).argmin())
        camera = cameras[image]
        x, y, z = camera.K @ camera.viewmat[:3, :3] @ batch.rays.directions[ray].double()
        row, column = int(y / z), int(x / z)
        view = scene.train[image]
        assert torch.equal(
            batch.targets[RGB].values[ray], view.images[RGB].load().values[row, column]
        )
        assert torch.equal(
            batch.targets[THERMAL].values[ray], view.images[THERMAL].load().values[row, column]
        )


def test_two_cameras_share_the_batch(tmp_path):
    batch = drawn(load_scene(write_scene(tmp_path / "scene", two_cameras=True)), count=10)
    assert (batch.targets[RGB].rows, batch.targets[THERMAL].rows) == (slice(0, 5), slice(5, 10))
    assert len(batch.rays.directions) == 10


def test_a_scene_may_have_one_modality(tmp_path):
    batch = drawn(load_scene(write_scene(tmp_path / "scene", rgb=False)), count=10)
    assert RGB not in batch.targets
    assert batch.targets[THERMAL].rows == slice(0, 10)


def test_masks_come_with_the_pixels(small_scene):
    scene = load_scene(small_scene)
    first = scene.train[0]
    pixels = first.images[THERMAL].load()
    masked = Pixels(pixels.values * 0 - 1, torch.zeros(pixels.values.shape[:2], dtype=torch.bool))
    photo = PosedImage(first.images[THERMAL].camera, lambda: masked)
    view = replace(first, images={**first.images, THERMAL: photo})
    batch = drawn(replace(scene, train=(view, *scene.train[1:])), count=500)
    assert batch.targets[RGB].valid is None
    assert torch.equal(batch.targets[THERMAL].valid, batch.targets[THERMAL].values[:, 0] >= 0)
    assert not batch.targets[THERMAL].valid.all()
