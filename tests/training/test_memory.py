from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch

from mrgs.data import load_scene
from mrgs.method.config import make_config
from mrgs.run_files.record import peak_memory_bytes
from mrgs.scene import THERMAL, Modality, Pixels, PosedImage, View
from mrgs.scene.capture import Capture
from mrgs.training.memory import estimate_bytes, gaussian_bytes
from mrgs.training.photos import kept_bytes
from tests.helpers.gaussians import NEAR_INFRARED


@pytest.mark.parametrize("method", ["mrgs", "3dgs-rgbt"])
def test_estimate_grows_with_the_gaussians_and_the_resolution(method, small_scene):
    scene, config = load_scene(small_scene), make_config(method)
    estimates = [estimate_bytes(scene, config, count) for count in (1_000, 50_000, 1_000_000)]
    assert estimates == sorted(set(estimates))
    assert estimate_bytes(load_scene(small_scene, resolution=20), config, 1_000) < estimates[0]


def test_the_baseline_needs_less(small_scene):
    scene = load_scene(small_scene)
    baseline, full = (
        estimate_bytes(scene, make_config(method), 10_000) for method in ("3dgs-rgbt", "mrgs")
    )
    assert baseline < full


def test_every_modality_counts(small_scene):
    """A band with one channel: an opacity, 16 spherical harmonics, and images of its own."""
    scene, config = load_scene(small_scene), make_config("mrgs")
    with_a_band = replace(
        scene,
        train=tuple(
            View(view.name, {**view.images, NEAR_INFRARED: view.images[THERMAL]})
            for view in scene.train
        ),
    )
    per_gaussian, with_band = (
        estimate_bytes(given, config, 1_001) - estimate_bytes(given, config, 1_000)
        for given in (scene, with_a_band)
    )
    floats_with_adam = 6 * (1 + 16)
    assert with_band - per_gaussian == 4 * floats_with_adam
    assert estimate_bytes(with_a_band, config, 0) > estimate_bytes(scene, config, 0)


def test_the_largest_view_needs_most(small_scene):
    scene, config = load_scene(small_scene), make_config("mrgs")
    first, *others = scene.train
    finer = {
        modality: replace(image, camera=image.camera.resized(400, 300))
        for modality, image in first.images.items()
    }
    larger = replace(scene, train=(*others, replace(first, images=finer)))
    pixels = 2 * (400 * 300 - first.camera.width * first.camera.height)
    more = estimate_bytes(larger, config, 100) - estimate_bytes(scene, config, 100)
    assert more >= 4 * 28 * pixels


def test_no_more_photos_count_than_are_kept(small_scene):
    scene, config = load_scene(small_scene), make_config("mrgs")
    large = {
        modality: replace(image, camera=image.camera.resized(10**6, 10**6))
        for modality, image in scene.train[0].images.items()
    }
    one, three = (
        replace(scene, train=(scene.train[0], *[replace(scene.train[1], images=large)] * count))
        for count in (1, 3)
    )
    assert kept_bytes(three) - kept_bytes(one) > 2**40
    more = estimate_bytes(three, config, 100) - estimate_bytes(one, config, 100)
    assert abs(more) < 2**36  # free memory comes and goes


def test_temperatures_that_depend_on_the_view_take_more(small_scene):
    """Sixteen numbers in place of one, with Adam's copies."""
    scene = load_scene(small_scene)
    even, own = (
        gaussian_bytes(
            replace(make_config("mrgs"), temperature_sh_degree=degree),
            scene.modalities,
            Capture.of(scene),
        )
        for degree in (0, 3)
    )
    assert own - even == 4 * 6 * 15


def test_the_compiler_takes_memory_once(small_scene):
    scene, config = load_scene(small_scene), make_config("mrgs")
    more = [
        estimate_bytes(scene, config, count, compiles=True) - estimate_bytes(scene, config, count)
        for count in (1_000, 50_000)
    ]
    assert more[0] == more[1] > 100 * 2**20


def test_a_torch_with_cuda_takes_more_without_a_gpu_too(small_scene, monkeypatch):
    scene, config = load_scene(small_scene), make_config("mrgs")
    estimates = []
    for version in (None, "13.0"):
        monkeypatch.setattr(torch.version, "cuda", version)
        estimates.append(estimate_bytes(scene, config, 1_000))
    assert estimates[1] - estimates[0] > 200 * 2**20


def test_photos_are_kept_with_their_channels(small_scene):
    scene, config = load_scene(small_scene), make_config("mrgs")
    fewer = replace(scene, train=scene.train[:-1])
    camera = scene.train[-1].camera
    difference = estimate_bytes(scene, config, 100) - estimate_bytes(fewer, config, 100)
    assert difference == (3 + 1) * camera.width * camera.height


def test_temperatures_that_are_no_grey_levels_are_kept_as_floats(small_scene):
    scene, config = load_scene(small_scene), make_config("mrgs")
    pixels = sum(view.camera.width * view.camera.height for view in scene.train)
    uneven = replace(
        scene, train=tuple(replace(view, images=_uneven(view.images)) for view in scene.train)
    )
    more = estimate_bytes(uneven, config, 100) - estimate_bytes(scene, config, 100)
    assert more == (4 - 1) * pixels


def _uneven(images: Mapping[Modality, PosedImage]) -> dict[Modality, PosedImage]:
    """The images of a view, with a temperature in each thermal one that 8 bits do not hold."""
    camera = images[THERMAL].camera
    values = torch.full((camera.height, camera.width, 1), 0.1234)
    return {**images, THERMAL: PosedImage(camera, lambda: Pixels(values))}


def test_peak_is_that_of_a_process_with_torch_in_it():
    assert 50 * 2**20 < peak_memory_bytes() < 2**40
