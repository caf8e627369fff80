"""Every problem of the pixels is found where it was made."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, uniform_filter1d

from mrgs.check.photos import WIDTH_PX, measure, sharpness
from mrgs.errors import scene_error
from mrgs.scene import RGB, THERMAL, Pixels, PosedImage, View
from mrgs.scene.radiometry import ObjectParameters, PhotoRecord
from tests.check.conftest import Checked
from tests.helpers.changed_views import repainted, with_image, without


def only_problem(looked, severity: str = "warning"):
    """The one problem of the images."""
    (problem,) = looked.photo_problems()
    assert problem.severity == severity
    assert problem.remedy
    return problem.text


def views_of(text: str) -> tuple[int, list[str]]:
    """How many views a problem concerns, and which it names."""
    count, names = re.search(r"(\d+) views? \((.*?)\)", text).groups()
    return int(count), names.split(", ")


def test_an_image_that_cannot_be_decoded_is_told(tabletop):
    def fail() -> Pixels:
        raise scene_error(
            "images/a.jpg", "cannot be decoded as an image (truncated); replace the file"
        )

    broken = tabletop.changed(
        lambda view: with_image(
            view, RGB, lambda image: replace(image, load=fail, load_at_least=None)
        ),
        every=100,
    )
    (problem,) = broken.photo_problems()
    assert problem.severity == "error"
    assert "images/a.jpg" in problem.text


@pytest.mark.parametrize("modality", [THERMAL, RGB], ids=str)
def test_views_that_lack_an_image_are_told(tabletop, modality):
    lacking = tabletop.changed(lambda view: without(view, modality), every=10)
    problem = only_problem(lacking)
    assert f"no {modality.title} image" in problem
    assert views_of(problem) == (2, [tabletop.scene.train[index].name for index in (0, 10)])


def test_a_scene_of_photos_alone_is_told(tabletop):
    scene = tabletop.scene
    views = [tuple(without(view, THERMAL) for view in part) for part in (scene.train, scene.eval)]
    (problem,) = Checked(
        replace(scene, train=views[0], eval=views[1], temperature=None), {}
    ).photo_problems()
    assert problem.severity == "warning"
    assert "temperatures" in problem.text


def test_thermal_images_alone_are_a_note(tabletop):
    scene = tabletop.scene
    views = [tuple(without(view, RGB) for view in part) for part in (scene.train, scene.eval)]
    (problem,) = Checked(replace(scene, train=views[0], eval=views[1]), {}).photo_problems()
    assert problem.severity == "note"
    assert "RGB" in problem.text


def test_missing_bounds_are_told(tabletop):
    (problem,) = Checked(replace(tabletop.scene, temperature=None), {}).photo_problems()
    assert "no temperature_bounds.json" in problem.text
    assert "absolute_min_temperature" in problem.remedy


def test_images_of_several_sizes_are_told(tabletop):
    def half(view: View) -> View:
        return with_image(
            view, THERMAL, lambda image: replace(image, camera=image.camera.resized(160, 120))
        )

    problem = only_problem(tabletop.posed(half, every=48), "note")
    assert "thermal" in problem
    assert "1 of 160×120 px, 27 of" in problem


@pytest.mark.parametrize("modality", [RGB, THERMAL])
def test_uniform_images_are_told(tabletop, modality):
    """Those of a camera whose lens cap was on."""

    def uniform(pixels: Pixels) -> Pixels:
        return replace(pixels, values=torch.full_like(pixels.values, 0.3))

    changed = tabletop.changed(
        lambda view: with_image(view, modality, lambda image: repainted(image, uniform)),
        every=100,
        first=2,
    )
    problems = changed.photo_problems()
    (found,) = [problem for problem in problems if "uniform" in problem.text]
    assert found.severity == "warning"
    assert f"{modality.title} image" in found.text
    assert views_of(found.text) == (1, [tabletop.scene.train[2].name])


def test_saturated_thermal_images_are_told(tabletop):
    def clipped(pixels: Pixels) -> Pixels:
        return replace(pixels, values=pixels.values.clamp(max=0.27) / 0.27)

    changed = tabletop.changed(
        lambda view: with_image(view, THERMAL, lambda image: repainted(image, clipped))
    )
    texts = [problem.text for problem in changed.photo_problems()]
    assert any("upper end" in text for text in texts)
    assert not any("lower end" in text for text in texts)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.06), (0.6, 0.0)])
def test_automatic_gain_is_told(tabletop, gain, offset):
    def changed_gain(pixels: Pixels) -> Pixels:
        return replace(pixels, values=pixels.values * gain + offset)

    changed = tabletop.changed(
        lambda view: with_image(view, THERMAL, lambda image: repainted(image, changed_gain)),
        every=9,
    )
    names = [tabletop.scene.train[index].name for index in (0, 9, 18)]
    texts = [problem.text for problem in changed.photo_problems()]
    assert [views_of(text) for text in texts if "warmer or colder" in text] == [(3, names)], texts


def test_radiometric_photos_that_do_not_agree_get_another_remedy(tabletop):
    record = PhotoRecord(parameters=ObjectParameters(0.95, 1.0, 20.0, 20.0, 0.5))

    def warmer(image: PosedImage) -> PosedImage:
        changed = repainted(image, lambda pixels: replace(pixels, values=pixels.values + 0.06))
        return replace(changed, record=record)

    changed = tabletop.changed(lambda view: with_image(view, THERMAL, warmer), every=9)
    (problem,) = (each for each in changed.photo_problems() if "warmer" in each.text)
    assert "photos are radiometric" in problem.text
    assert "Export" not in problem.remedy


def test_automatic_exposure_is_told(tabletop):
    def darker(pixels: Pixels) -> Pixels:
        return replace(pixels, values=pixels.values * 0.7)

    changed = tabletop.changed(
        lambda view: with_image(view, RGB, lambda image: repainted(image, darker)), every=12
    )
    problem = only_problem(changed)
    assert "brighter or darker" in problem
    assert views_of(problem) == (2, [tabletop.scene.train[index].name for index in (0, 12)])


@pytest.mark.parametrize("blur", [
    lambda image: gaussian_filter(image, (2, 2, 0)),
    lambda image: uniform_filter1d(image, 9, axis=1),
])  # fmt: skip
def test_blurred_photos_are_told(tabletop, blur):
    def blurred(pixels: Pixels) -> Pixels:
        return replace(pixels, values=torch.from_numpy(blur(pixels.values.numpy())))

    changed = tabletop.changed(
        lambda view: with_image(view, RGB, lambda image: repainted(image, blurred)),
        every=100,
        first=9,
    )
    problem = only_problem(changed)
    assert "less sharp" in problem
    assert views_of(problem) == (1, [tabletop.scene.train[9].name])


def test_large_photos_are_measured_in_fewer_pixels(tabletop):
    image = tabletop.scene.train[0].images[RGB]
    found = measure(Pixels(image.load().values[::2, ::2]), image)
    assert found.small.shape == (120, 160)
    assert found.camera.width == 160
    assert found.spread == pytest.approx(measure(image.look(WIDTH_PX), image).spread, abs=0.05)


def test_sharpness_does_not_depend_on_contrast_and_falls_with_blur():
    image = np.random.default_rng(0).uniform(0, 1, (60, 80))
    assert sharpness(0.1 * image) == pytest.approx(sharpness(image))
    values = [sharpness(gaussian_filter(image, sigma)) for sigma in (0, 0.7, 1.5, 3)]
    assert values == sorted(values, reverse=True)
    assert sharpness(np.ones((7, 5))) == 0
    assert sharpness(np.ones((1, 1))) == 0
