from __future__ import annotations

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.check import fast_problems
from mrgs.check.photos import measure_few
from mrgs.data import load_scene
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


def texts(scene) -> list[str]:
    """The fast problems, each with its remedy."""
    return [f"{problem.text} {problem.remedy}" for problem in fast_problems(scene)]


def moved(camera: Camera, x: float) -> Camera:
    viewmat = camera.viewmat.clone()
    viewmat[0, 3] += x
    return Camera(camera.K, viewmat, camera.width, camera.height)


def test_a_usual_scene_is_not_odd(folder):
    assert texts(load_scene(folder)) == []


def test_cameras_that_look_the_other_way(folder):
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))

    def flipped(camera: Camera, _: int) -> Camera:
        return Camera(camera.K, flip @ camera.viewmat, camera.width, camera.height)

    scene = with_cameras(load_scene(folder), flipped)
    (found,) = texts(scene)
    assert "as in OpenCV" in found
    assert "Negate" in found
    (found,) = texts(replace(scene, path=""))
    assert "world-to-camera" in found


def test_coordinates_of_a_map(folder):
    scene = load_scene(folder)
    shift = torch.tensor([5e5, 5.4e6, 300.0], dtype=torch.float64)

    def shifted(camera: Camera, _: int) -> Camera:
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] -= viewmat[:3, :3] @ shift
        return Camera(camera.K, viewmat, camera.width, camera.height)

    positions = (scene.points.positions.double() + shift).float()
    points = replace(scene.points, positions=positions)
    found = texts(replace(with_cameras(scene, shifted), points=points))
    assert "5.4e+06 units from the origin" in found[0]


@pytest.mark.parametrize(
    ("modality", "value", "message"),
    [
        ("images", 0, "RGB .* black"),
        ("images", 99, "RGB .* uniform"),
        ("thermal", 77, "thermal .* uniform"),
    ],
)
def test_photos_of_one_value(folder, tmp_path, modality, value, message):
    scene = painted(
        folder, tmp_path, modality, lambda pixels, _: Image.fromarray(np.full_like(pixels, value))
    )
    (found,) = texts(scene)
    assert re.search(message, found)


def test_photos_that_are_the_same(folder, tmp_path):
    first = []

    def same(pixels, _):
        first.append(pixels)
        return Image.fromarray(first[0])

    (found,) = texts(painted(folder, tmp_path, "images", same))
    assert re.search(r"RGB .* identical", found)


@pytest.mark.parametrize("bits", [12, 14])
def test_thermal_photos_that_use_few_of_16_bits(folder, tmp_path, bits):
    def deep(pixels, place):
        values = pixels.astype(np.uint16) * 2 ** (bits - 8) + np.uint16(place + 1)
        return Image.fromarray(np.minimum(values, 2**bits - 1))

    (found,) = texts(painted(folder, tmp_path, "thermal", deep))
    assert re.search(rf"thermal .* {bits} of .*16 bits", found)


def test_poses_that_are_the_same(folder):
    scene = load_scene(folder)
    camera = scene.train[0].camera
    (found,) = texts(with_cameras(scene, lambda *_: camera))
    assert re.search(r"All 6 .* pose", found)
    (found,) = texts(with_cameras(scene, lambda own, place: camera if place < 3 else own))
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
    (found,) = texts(apart)
    assert re.search("away|overlap", found)
    assert f"({many[5].name})" in found


def test_photos_that_serve_twice(folder):
    scene = load_scene(folder)
    first, second, *others = scene.train
    images = {each: replace(image, load=first.images[each].load, files=first.images[each].files)
              for each, image in second.images.items()}  # fmt: skip
    (found,) = texts(replace(scene, train=(first, View(second.name, images), *others)))
    assert re.search(r"2 of 10 photos .*several", found)


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
    found = texts(replace(scene, train=views))
    assert any("black" in text for text in found)
    assert len(measure_few(scene)[RGB]) == len(views)
