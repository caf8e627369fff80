from __future__ import annotations

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data import load_scene
from mrgs.data.oddities import _looked_at, _thinned, oddities
from mrgs.scene import RGB, Camera, PosedImage, View
from tests.helpers.scenes import write_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("odd") / "scene")


def painted(folder, tmp_path, modality, change):
    """The scene with the images of a modality changed."""
    shutil.copytree(folder, tmp_path / "scene")
    for place, path in enumerate(sorted((tmp_path / "scene" / modality).glob("*.png"))):
        change(np.asarray(Image.open(path)), place).save(path)
    return load_scene(tmp_path / "scene")


def with_cameras(scene, change):
    """The scene with the camera of each training view changed."""
    views = []
    for place, view in enumerate(scene.train):
        images = {
            modality: PosedImage(change(image.camera, place), image.load)
            for modality, image in view.images.items()
        }
        views.append(View(view.name, images))
    return replace(scene, train=tuple(views))


def moved(camera: Camera, x: float) -> Camera:
    viewmat = camera.viewmat.clone()
    viewmat[0, 3] += x
    return Camera(camera.K, viewmat, camera.width, camera.height)


def test_a_usual_scene_is_not_odd(folder):
    assert oddities(load_scene(folder)) == []


def test_cameras_that_look_the_other_way(folder):
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))

    def flipped(camera: Camera, _: int) -> Camera:
        return Camera(camera.K, flip @ camera.viewmat, camera.width, camera.height)

    scene = with_cameras(load_scene(folder), flipped)
    (found,) = oddities(scene)
    assert re.match(r"all training views together see \d% of the points: .* mrgs check", found)
    (found,) = oddities(replace(scene, path=""))
    assert found.endswith("cameras take world to camera, with x right, y down and z forward")


def test_coordinates_of_a_map(folder):
    scene = load_scene(folder)
    shift = torch.tensor([5e5, 5.4e6, 300.0], dtype=torch.float64)

    def shifted(camera: Camera, _: int) -> Camera:
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] -= viewmat[:3, :3] @ shift
        return Camera(camera.K, viewmat, camera.width, camera.height)

    positions = (scene.points.positions.double() + shift).float()
    points = replace(scene.points, positions=positions)
    found = oddities(replace(with_cameras(scene, shifted), points=points))
    assert found[0].startswith("it lies 5.4e+06 units from the origin")


@pytest.mark.parametrize(
    ("modality", "value", "message"),
    [
        ("images", 0, "RGB .* black"),
        ("images", 99, "RGB .* one colour"),
        ("thermal", 77, "thermal .* one temperature"),
    ],
)
def test_photos_of_one_value(folder, tmp_path, modality, value, message):
    scene = painted(
        folder, tmp_path, modality, lambda pixels, _: Image.fromarray(np.full_like(pixels, value))
    )
    (found,) = oddities(scene)
    assert re.search(message, found)


def test_photos_that_are_the_same(folder, tmp_path):
    first = []

    def same(pixels, _):
        first.append(pixels)
        return Image.fromarray(first[0])

    (found,) = oddities(painted(folder, tmp_path, "images", same))
    assert re.search(r"RGB .* the same", found)


@pytest.mark.parametrize("bits", [12, 14])
def test_thermal_photos_that_use_few_of_16_bits(folder, tmp_path, bits):
    def deep(pixels, place):
        values = pixels.astype(np.uint16) * 2 ** (bits - 8) + np.uint16(place + 1)
        return Image.fromarray(np.minimum(values, 2**bits - 1))

    (found,) = oddities(painted(folder, tmp_path, "thermal", deep))
    assert re.search(rf"thermal .* {bits} of .*16 bits", found)


def test_poses_that_are_the_same(folder):
    scene = load_scene(folder)
    camera = scene.train[0].camera
    (found,) = oddities(with_cameras(scene, lambda *_: camera))
    assert re.search(r"all 6 .* pose", found)
    (found,) = oddities(with_cameras(scene, lambda own, place: camera if place < 3 else own))
    assert re.search(r"2 of 6 .* pose", found)


def test_a_view_that_no_other_overlaps(folder):
    scene = load_scene(folder)
    many = tuple(
        View(f"view_{copy}_{view.name}", view.images) for copy in range(3) for view in scene.train
    )
    points = torch.cat([scene.points.positions] * 4)
    points = points + 0.01 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    scene = replace(
        scene, train=many, points=replace(scene.points, positions=points, colors=points.abs())
    )
    apart = with_cameras(
        scene, lambda camera, place: moved(camera, 1e6 if place == 5 else 1e-4 * place)
    )
    (found,) = oddities(apart)
    assert re.search(rf"1 of 18 .*\({many[5].name}\)", found)


def test_photos_that_serve_twice(folder):
    scene = load_scene(folder)
    first, second, *others = scene.train
    images = {each: replace(image, load=first.images[each].load, files=first.images[each].files)
              for each, image in second.images.items()}  # fmt: skip
    (found,) = oddities(replace(scene, train=(first, View(second.name, images), *others)))
    assert re.search(r"2 of 10 photos .*several", found)


def test_large_photos_are_thinned_before_they_are_kept():
    photo = torch.arange(3.0 * 1200 * 900).reshape(1200, 900, 3)
    thinned = _thinned(photo)
    assert torch.equal(thinned, photo[::3, ::3])
    assert thinned.untyped_storage().nbytes() == thinned.nbytes
    assert torch.equal(_thinned(thinned), thinned)


def test_a_large_jpeg_is_looked_at_without_reading_it_whole(folder, tmp_path):
    black = tmp_path / "black.jpg"
    Image.new("RGB", (2560, 1280)).save(black)
    scene = load_scene(folder)

    def whole():
        raise AssertionError("the whole photo is not needed")

    def as_jpeg(view):
        image = replace(view.images[RGB], load=whole, files=(black,))
        return View(view.name, {**view.images, RGB: image})

    views = tuple(map(as_jpeg, scene.train))
    found = oddities(replace(scene, train=views))
    assert any("are black" in text for text in found)
    assert _looked_at(RGB, views[0].images[RGB]).shape == (320, 640, 3)
