from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
import torch

from mrgs.data import load_scene
from mrgs.export.cameras import write_cameras
from mrgs.scene import (
    RGB,
    THERMAL,
    Camera,
    EarthPosition,
    Pixels,
    PosedImage,
    View,
    WorldFrame,
)
from mrgs.scene.radiometry import ObjectParameters, PhotoRecord, Planck
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.scenes import write_scene


@pytest.fixture(params=[False, True], ids=["one camera", "two cameras"])
def original(request, tmp_path):
    return load_scene(write_scene(tmp_path / "scene", two_cameras=request.param))


def same_cameras(found, expected):
    torch.testing.assert_close(found.K, expected.K, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.viewmat, expected.viewmat, atol=1e-9, rtol=0)
    assert (found.width, found.height) == (expected.width, expected.height)


def same_views(found, expected):
    assert [view.name for view in found] == [view.name for view in expected]
    for one, other in zip(found, expected, strict=True):
        assert list(one.images) == list(other.images)
        for modality, image in one.images.items():
            same_cameras(image.camera, other.images[modality].camera)
            expected_values = other.images[modality].load().values
            torch.testing.assert_close(image.load().values, expected_values, atol=1e-6, rtol=0)


def test_transforms_json_reads_back(tmp_path, original):
    write_cameras(tmp_path / "out", original)
    found = load_scene(tmp_path / "out")
    same_views(found.train, original.train)
    same_views(found.eval, original.eval)
    assert found.temperature == original.temperature
    torch.testing.assert_close(found.points.positions, original.points.positions)
    assert (tmp_path / "out" / "images" / f"{original.train[0].name}.png").is_file()


def test_the_colmap_model_reads_back(tmp_path, original):
    write_cameras(tmp_path / "out", original)
    (tmp_path / "out" / "transforms.json").unlink()
    found = load_scene(tmp_path / "out")
    same_views(found.train, original.train)
    torch.testing.assert_close(found.points.positions, original.points.positions)
    torch.testing.assert_close(found.points.colors, original.points.colors, atol=1e-6, rtol=0)


def test_the_place_on_earth_reads_back(tmp_path, original):
    world = WorldFrame(True, True, EarthPosition(48.137, 11.575, 520.0), 0.8, 0.002)
    write_cameras(tmp_path / "out", replace(original, world=world))
    assert load_scene(tmp_path / "out").world == world


def test_every_camera_of_the_colmap_model_has_its_own_intrinsics(tmp_path, original):
    def finer(number: int, view: View) -> View:
        images = {
            each: replace(
                image,
                camera=Camera(
                    image.camera.K
                    + number * torch.diag(torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)),
                    image.camera.viewmat,
                    image.camera.width,
                    image.camera.height,
                ),
            )
            for each, image in view.images.items()
        }
        return replace(view, images=images)

    train = tuple(finer(number % 3, view) for number, view in enumerate(original.train))
    write_cameras(tmp_path / "out", replace(original, train=train))
    (tmp_path / "out" / "transforms.json").unlink()
    found = {view.name: view for view in load_scene(tmp_path / "out").views}
    for view in train:
        same_cameras(found[view.name].images[RGB].camera, view.images[RGB].camera)


def test_where_one_view_has_two_cameras_colmap_s_names_tell_them_apart(tmp_path):
    """The other views, whose images share a camera, are named alike."""
    original = load_scene(write_scene(tmp_path / "scene"))
    view = original.train[0]
    camera = view.images[THERMAL].camera
    moved = camera.viewmat.clone()
    moved[0, 3] += 0.1
    thermal = replace(
        view.images[THERMAL], camera=Camera(camera.K, moved, camera.width, camera.height)
    )
    apart = replace(view, images=view.images | {THERMAL: thermal})
    write_cameras(tmp_path / "out", replace(original, train=(apart, *original.train[1:])))
    lines = (tmp_path / "out" / "sparse" / "0" / "images.txt").read_text().splitlines()[1::2]
    names = [line.split()[9] for line in lines]
    assert len(set(names)) == 2 * len(original.views)
    assert all(name.startswith(("images/", "thermal/")) for name in names)


def test_transforms_json_is_camera_to_world_with_opengl_axes(tmp_path, original):
    write_cameras(tmp_path / "out", original)
    frame = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"][0]
    pose, camera = np.array(frame["transform_matrix"]), original.train[0].images[RGB].camera
    np.testing.assert_allclose(pose[:3, 3], camera.position)
    np.testing.assert_allclose(-pose[:3, 2], camera.forward)  # looks along −z
    np.testing.assert_allclose(pose[:3, 1], -camera.viewmat[1, :3])  # y is up


def test_colmap_is_world_to_camera_with_opencv_axes(tmp_path, original):
    write_cameras(tmp_path / "out", original)
    line = (tmp_path / "out" / "sparse" / "0" / "images.txt").read_text().splitlines()[1].split()
    camera = original.train[0].images[RGB].camera
    np.testing.assert_allclose(
        [float(word) for word in line[5:8]], camera.viewmat[:3, 3], atol=1e-12
    )
    name = f"{original.train[0].name}.png"
    assert line[9] == (name if original.train[0].shares_camera(RGB, THERMAL) else f"images/{name}")


def test_without_celsius_thermal_images_are_16_bit(tmp_path, original):
    write_cameras(tmp_path / "out", replace(original, temperature=None))
    found = load_scene(tmp_path / "out")
    assert found.temperature is None
    values = found.train[0].images[THERMAL].load().values
    torch.testing.assert_close(
        values, original.train[0].images[THERMAL].load().values, atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("modality", [RGB, THERMAL])
def test_scenes_of_one_modality(tmp_path, original, modality):
    alone = replace(
        original,
        train=tuple(View(view.name, {modality: view.images[modality]}) for view in original.train),
        eval=(),
    )
    write_cameras(tmp_path / "out", alone)
    for _ in range(2):  # transforms.json, then COLMAP
        found = load_scene(tmp_path / "out")
        views = found.views
        assert all(list(view.images) == [modality] for view in views)
        cameras = {view.name: view.camera for view in views}
        for view in alone.train:
            same_cameras(cameras[view.name], view.camera)
        (tmp_path / "out" / "transforms.json").unlink(missing_ok=True)


def test_a_third_modality_reads_back(tmp_path, original):
    def with_infrared(views):
        return tuple(
            View(view.name, {**view.images, NEAR_INFRARED: view.images[THERMAL]}) for view in views
        )

    original = replace(
        original, train=with_infrared(original.train), eval=with_infrared(original.eval)
    )
    paths = write_cameras(tmp_path / "out", original)
    assert tmp_path / "out" / "nir" / f"{original.train[0].name}.png" in paths
    found = load_scene(tmp_path / "out")
    assert found.modalities == (RGB, THERMAL, NEAR_INFRARED)
    for one, other in zip(found.train, original.train, strict=True):
        for modality, camera in one.cameras.items():
            same_cameras(camera, other.cameras[modality])
        values = one.images[NEAR_INFRARED].load().values
        expected = other.images[THERMAL].load().values
        torch.testing.assert_close(values, expected, atol=1e-5, rtol=0)


def test_what_the_camera_noted_reads_back(tmp_path, original):
    record = PhotoRecord(
        "FLIR radiometric JPEG",
        "FLIR T640",
        "55903123",
        datetime(2026, 1, 12, 6, 31, 7),
        ObjectParameters(0.93, 12.5, -8.0, 1.5, 0.62),
        Planck(17_096.453, 0.0465, 1428.5, 1.0, -125.0),
        {"emissivity": 0.93},
    )
    first = original.train[0]
    noted = replace(first, images={
        modality: replace(image, record=record if modality == THERMAL else None)
        for modality, image in first.images.items()
    })  # fmt: skip
    write_cameras(tmp_path / "out", replace(original, train=(noted, *original.train[1:])))
    found = load_scene(tmp_path / "out").train
    assert found[0].images[THERMAL].record == record
    assert found[0].images[RGB].record is None
    assert found[1].images[THERMAL].record is None


def test_masks_are_kept(tmp_path, original):
    view = original.train[0]

    def masked(image: PosedImage) -> PosedImage:
        values = image.load().values
        valid = torch.ones(values.shape[:2], dtype=torch.bool)
        valid[:5] = False
        return replace(image, load=lambda: Pixels(values, valid))

    view = replace(view, images={each: masked(image) for each, image in view.images.items()})
    write_cameras(tmp_path / "out", replace(original, train=(view,), eval=()))
    found = load_scene(tmp_path / "out").train[0]
    for image in (found.images[RGB], found.images[THERMAL]):
        assert not image.load().valid[:5].any()
        assert image.load().valid[5:].all()
