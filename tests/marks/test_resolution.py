"""Hot and cold places on a wall, wider and narrower than the photos resolve."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from mrgs.marks import Mark
from mrgs.marks.measure import NARROW_COLD, NARROW_HOT, MarkMeter
from mrgs.marks.photo_readings import BLURRED, READING, RENDERED, USUAL_BLUR_PX, PhotoReadings
from mrgs.marks.resolution import Resolution
from mrgs.marks.tables import facts_of_reading, mark_text, text_rows
from mrgs.marks.uncertainty import Budget, UncertaintyMeter
from mrgs.method.camera_model.point_spread import blur
from mrgs.scene import (
    THERMAL,
    Blend,
    Camera,
    Pixels,
    PosedImage,
    Rendering,
    View,
    WorldFrame,
    ideal_cameras,
)
from mrgs.scene.depth_map import PhotoSurvey
from tests.helpers.walls import RANGE, camera_before_wall, render_wall

EYE = (0.0, -5.0, 0.0)
CAMERAS = [camera_before_wall(x) for x in (-0.4, 0.0, 0.4)]
PIXEL_M = 5 / float(CAMERAS[0].K[0, 0])
BOX = Mark("B1", "box", ((-0.4, 0.0, -0.4), (0.4, 0.0, -0.4), (0.4, 0.0, 0.4), (-0.4, 0.0, 0.4)),
           EYE)  # fmt: skip


class WallWithSpot:
    """The wall with a round place in its middle that is hotter by ``height_c``, of which the width
    at half its height is ``width_px`` pixels of the photos."""

    def __init__(self, height_c: float, width_px: float, long: bool = False) -> None:
        self.height_c = height_c
        self.sigma = width_px * PIXEL_M / (2 * math.sqrt(2 * math.log(2)))
        self.along = 100 * self.sigma if long else self.sigma

    def __call__(self, camera: Camera) -> Rendering:
        """Rendered as seen from a camera."""
        wall = render_wall(camera)[THERMAL]
        points = camera.unproject_image(wall.depth)
        away = (points[..., 0] / self.sigma) ** 2 + (points[..., 2] / self.along) ** 2
        more = self.height_c / RANGE.span_c * torch.exp(-0.5 * away)[..., None]
        return Rendering({THERMAL: Blend(wall.image + more, wall.depth, wall.alpha)})

    def width_px(self, sign: int = 1, least: float = 0.01) -> float:
        """Its width as it is measured."""
        resolution = Resolution(self, PhotoSurvey(self, CAMERAS))
        return resolution.width_px((0.0, 0.0, 0.0), sign, least)

    def reading(self, mark: Mark = BOX):
        """A mark on it as it is measured."""
        views = [
            View(f"v{number}", {THERMAL: PosedImage(camera, lambda c=camera: self.photo(c))})
            for number, camera in enumerate(CAMERAS)
        ]
        witnesses = PhotoReadings(self, ideal_cameras, views, RANGE)
        meter = MarkMeter(self, RANGE, CAMERAS, uncertainty=UncertaintyMeter(witnesses, Budget()))
        return meter.read(mark)

    def photo(self, camera: Camera) -> Pixels:
        """What the camera records."""
        return Pixels(self(camera)[THERMAL].image.float())


@pytest.mark.parametrize("width_px", [2.0, 3.0, 5.0])
def test_the_width_is_that_at_half_the_height(width_px):
    assert WallWithSpot(10.0, width_px).width_px() == pytest.approx(width_px, abs=0.7)


def test_the_narrowest_direction_counts():
    assert WallWithSpot(10.0, 2.0, long=True).width_px() == pytest.approx(2.0, abs=0.7)


def test_what_does_not_stand_out_has_no_width():
    assert WallWithSpot(10.0, 2.0).width_px(least=0.5) == np.inf
    assert WallWithSpot(0.0, 2.0).width_px() == np.inf  # an even slope
    assert WallWithSpot(10.0, 2.0).width_px(sign=-1) == np.inf


def test_what_no_photo_shows_has_no_width():
    wall = WallWithSpot(10.0, 2.0)
    resolution = Resolution(wall, PhotoSurvey(wall, CAMERAS))
    assert resolution.width_px((0.0, 1.0, 0.0), 1, 0.01) == np.inf
    at_border = (0.0, 0.0, 0.5 * 115 * PIXEL_M)
    assert resolution.width_px(at_border, 1, 0.01) == np.inf


def test_a_mark_says_that_its_hot_place_is_narrow():
    reading = WallWithSpot(10.0, 2.0).reading()
    assert reading.remarks == (NARROW_HOT,)
    assert NARROW_HOT in mark_text(reading, "", RANGE, WorldFrame())["lines"]
    assert text_rows([reading], RANGE, WorldFrame())[0][-1] == NARROW_HOT
    assert facts_of_reading(reading, RANGE, WorldFrame())["remarks"] == NARROW_HOT


def test_a_mark_says_that_its_cold_place_is_narrow():
    assert WallWithSpot(-10.0, 2.0).reading().remarks == (NARROW_COLD,)


def test_a_spot_is_remarked_in_its_middle_alone():
    def remarks(x_px: float) -> tuple[str, ...]:
        spot = Mark("S1", "spot", ((x_px * PIXEL_M, 0.0, 0.0),), EYE, radius=1.5 * PIXEL_M)
        return WallWithSpot(10.0, 2.0).reading(spot).remarks

    assert remarks(0.0) == (NARROW_HOT,)
    assert remarks(3.5) == ()


class CutHotPlace(WallWithSpot):
    """A hot place that is wide, with a narrow cut in its middle that is less hot."""

    def __call__(self, camera: Camera) -> Rendering:
        """Rendered as seen from a camera."""
        wall, cut, hot = (
            each(camera)[THERMAL]
            for each in (render_wall, super().__call__, WallWithSpot(20.0, 16.0))
        )
        image = hot.image + cut.image - wall.image
        return Rendering({THERMAL: wall._replace(image=image)})


def test_a_spot_on_something_hot_is_no_cold_place():
    wall = CutHotPlace(-5.0, 2.0)
    spot = Mark("H1", "spot", ((0.0, 0.0, 0.0),), EYE, radius=1.5 * PIXEL_M)
    assert wall.width_px(sign=-1, least=0.05) < 3
    assert NARROW_COLD not in wall.reading(spot).remarks


@pytest.mark.parametrize(("height_c", "width_px"), [(10.0, 5.0), (0.5, 2.0), (0.0, 2.0)])
def test_wide_and_faint_places_are_not_remarked(height_c, width_px):
    assert WallWithSpot(height_c, width_px).reading().remarks == ()


@pytest.mark.parametrize("width", [160, 640])
def test_photos_wider_than_what_is_compared_are_blurred_by_their_own_pixels(width):
    """The blur is in pixels of the photos; wide ones are compared at half of their width."""
    camera = Camera.from_fov(width, width * 3 // 4, 60.0).look_at([0.0, -5.0, 0.0], [0.0, 0.0, 0.0])
    wall = WallWithSpot(10.0, 8.0 * 160 / width)
    sigma_px = torch.tensor(2.0)

    def respond(rendering, camera, pixel_sizes):
        image = rendering[THERMAL].image[..., 0].float()
        blurred = blur(image, sigma_px / pixel_sizes[THERMAL])
        return rendering.with_images({THERMAL: blurred[..., None].double()})

    photo = respond(wall(camera), camera, {THERMAL: 1.0})[THERMAL].image.float()
    view = View("v", {THERMAL: PosedImage(camera, lambda: Pixels(photo))})
    seen = PhotoReadings(wall, respond, [view], RANGE)[0].image
    row, column = (side // 2 for side in seen.shape[:2])
    middle = seen[row - 20 : row + 20, column - 20 : column + 20]
    assert np.abs(middle[..., READING] - middle[..., RENDERED]).max() < 0.15


def blurring_of(wall: WallWithSpot, gain: float, sigma_px: float | None) -> np.ndarray:
    """What the blur of a camera changes in the middle of its photo, K."""

    def respond(rendering, camera, pixel_sizes):
        image = rendering[THERMAL].image[..., 0].float()
        if sigma_px is not None:
            image = blur(image, torch.tensor(sigma_px))
        return rendering.with_images({THERMAL: (gain * image + 0.1)[..., None].double()})

    photo = respond(wall(CAMERAS[1]), CAMERAS[1], {})[THERMAL].image.float()
    view = View("v", {THERMAL: PosedImage(CAMERAS[1], lambda: Pixels(photo))})
    change = PhotoReadings(wall, respond, [view], RANGE)[0].image[..., BLURRED]
    return change[58:62, 78:82]


@pytest.mark.parametrize("gain", [1.0, 1.3])
def test_what_the_blur_of_a_camera_takes_from_a_peak(gain):
    """The variances of peak and blur add, whatever gain and offset the photo has."""
    width_px, sigma_px = 8.0, 1.5
    peak_px = width_px / 2.3548
    left = 10 * peak_px**2 / (peak_px**2 + sigma_px**2)
    change = blurring_of(WallWithSpot(10.0, width_px), gain, sigma_px)
    assert change.min() == pytest.approx(left - 10, rel=0.05)


def test_a_camera_without_a_known_blur_is_taken_to_have_a_usual_one():
    wall = WallWithSpot(10.0, 16.0)
    usual = blurring_of(wall, 1.0, None)
    assert usual == pytest.approx(blurring_of(wall, 1.0, USUAL_BLUR_PX), rel=0.1)
    assert usual.max() < -0.3


def test_a_wide_hot_place_is_told_from_a_narrow_one():
    """A peak that the photos resolve is known better than its contrast to what is around it."""
    wide, narrow = (blurring_of(WallWithSpot(10.0, each), 1.0, 0.7).min() for each in (8.0, 2.0))
    assert -0.5 < wide < 0
    assert narrow < -2
