from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace

import pytest
import torch

from mrgs.evaluation.held_out_poses import (
    MOST_VIEWS,
    aligned_view,
    held_out_error,
    looked_at_first,
)
from mrgs.render import Model, render
from mrgs.scene import RGB, THERMAL, Camera, Modality, Pixels, PosedImage, Rendering, View
from tests.helpers.colored_ball import colored_ball, orbit, photographed


class Showing:
    """Stands in for a run that shows a model."""

    modalities = (RGB, THERMAL)

    def __init__(self, model: Model) -> None:
        self._model = model

    def render_cameras(self, cameras: Mapping[Modality, Camera]) -> Rendering:
        with torch.no_grad():
            return render(self._model, cameras)[0]

    def camera_response(self, rendering: Rendering, *_: object) -> Rendering:
        return rendering


BALL = Showing(colored_ball())


def offset_px(camera: Camera, other: Camera) -> float:
    """How far two cameras see the middle of the scene apart."""
    (a, _), (b, _) = camera.project(torch.zeros(1, 3)), other.project(torch.zeros(1, 3))
    return float((a - b).norm())


def test_photos_are_laid_where_they_were_taken():
    views, right = photographed(wrong_px=2.0, views=12).train, orbit(views=12)
    error = held_out_error(BALL, views)
    assert error is not None
    assert error.found.is_wrong
    assert error.photo_px == pytest.approx(2.0, rel=0.2)
    for view, camera in zip(views[:2], right[:2], strict=True):
        found = aligned_view(BALL, view)
        assert offset_px(view.camera, camera) > 1.5
        assert offset_px(found.camera, camera) < 0.1
        assert found.images[THERMAL].camera.coincides_with(found.camera)
        assert found.images[RGB].load is view.images[RGB].load


def test_right_poses_are_found_right():
    error = held_out_error(BALL, photographed(wrong_px=0.0, views=12).train)
    assert error is not None
    assert error.photo_px < 0.05
    assert not error.found.is_wrong


@pytest.mark.slow
def test_a_model_of_something_else_tells_nothing():
    """Each half of a photo differs from it in another way."""
    error = held_out_error(Showing(colored_ball(seed=5)), photographed(wrong_px=2.0).train)
    assert error is not None
    assert not error.found.is_wrong
    assert error.photo_px is None


def test_the_error_is_in_pixels_of_the_photo():
    """In photos so large that they are looked at in larger pixels."""
    width, height = 656, 480
    views = photographed(wrong_px=8.0, width=width, height=height, views=4).train
    error = held_out_error(BALL, views)
    assert error is not None
    assert error.pixel_size == 2
    assert error.photo_px == pytest.approx(8.0, rel=0.2)
    assert offset_px(aligned_view(BALL, views[0]).camera, orbit(width, height)[0]) < 0.4


def test_where_nothing_is_shown_nothing_is_told():
    empty = colored_ball()
    hidden = {each: logit - 20 for each, logit in empty.gaussians.opacity_logits.items()}
    run = Showing(replace(empty, gaussians=replace(empty.gaussians, opacity_logits=hidden)))
    views = photographed(wrong_px=2.0, views=4).train
    assert held_out_error(run, views) is None
    assert offset_px(aligned_view(run, views[0]).camera, views[0].camera) == 0


def test_photos_that_the_model_does_not_render_are_left_out():
    class Colours(Showing):
        modalities = (RGB,)

    run = Colours(colored_ball())
    views = photographed(wrong_px=2.0, views=12).train
    thermal = [View(view.name, {THERMAL: view.images[THERMAL]}) for view in views]
    assert held_out_error(run, thermal) is None
    error = held_out_error(run, [thermal[0], *views[1:]])
    assert error is not None
    assert error.photo_px == pytest.approx(2.0, rel=0.2)


def test_few_views_tell_nothing():
    views = photographed(wrong_px=2.0, views=4).train
    assert looked_at_first(views[:3]) == []
    assert held_out_error(BALL, views[:3]) is None
    assert held_out_error(BALL, views[:4]) is not None


def test_of_many_views_some_are_looked_at():
    few = photographed(wrong_px=0.0, views=4).train
    views = [View(str(number), few[0].images) for number in range(3 * MOST_VIEWS)]
    numbers = [int(view.name) for view in looked_at_first(views)]
    assert (len(numbers), numbers[0], numbers[-1]) == (MOST_VIEWS, 0, len(views) - 1)
    assert {b - a for a, b in itertools.pairwise(numbers)} <= {3, 4}
    assert looked_at_first(few) == list(few)
    assert looked_at_first([]) == []


def changed(view: View, change: Callable[[Pixels], Pixels]) -> View:
    def load(image: PosedImage) -> PosedImage:
        return replace(image, load=lambda: change(image.load()))

    return View(view.name, {each: load(image) for each, image in view.images.items()})


@pytest.mark.slow
def test_photos_of_nothing_that_the_model_shows_tell_nothing():
    generator = torch.Generator().manual_seed(0)

    def noise(pixels: Pixels) -> Pixels:
        return Pixels(torch.rand(pixels.values.shape, generator=generator))

    views = [changed(view, noise) for view in photographed(wrong_px=0.0).train]
    error = held_out_error(BALL, views)
    assert error is not None
    assert error.photo_px is None


def test_masked_photos_do_not_count_as_right():
    def masked(pixels: Pixels) -> Pixels:
        return Pixels(pixels.values, torch.zeros(pixels.values.shape[:2], dtype=torch.bool))

    views = photographed(wrong_px=2.0, views=10).train
    hidden = [changed(view, masked) for view in views[:4]]
    assert held_out_error(BALL, hidden) is None
    error = held_out_error(BALL, [*hidden, *views[4:]])
    assert error is not None
    assert error.photo_px == pytest.approx(2.0, rel=0.3)


def test_a_photo_that_fits_nowhere_stays_where_it_was():
    (view,) = photographed(wrong_px=0.0, views=1).train
    black = changed(view, lambda pixels: Pixels(torch.zeros_like(pixels.values)))
    given, found = black.camera, aligned_view(BALL, black).camera

    def fit(camera: Camera) -> float:
        return float(BALL.render_cameras({RGB: camera})[RGB].image.square().mean())

    assert fit(found) <= fit(given)
