"""Which hot and cold places of a model the thermal photos resolve.

A camera measures the temperature of what covers about three of its pixels (the measurement field of
view of its data sheet); anything narrower is mixed with what is beside it, so that a hot wire
looks colder than it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from mrgs.marks.surface import thermal_values
from mrgs.scene.depth_map import PhotoSurvey, SurfaceRenderer

RESOLVED_PX = 3.0
"""Width from which on a temperature is measured."""

ABOUT_PX = 8
"""Radius of the inspected surroundings of a place, pixels."""

SURROUNDINGS_SHARE = 0.4
"""Side of what counts as the surroundings of a spot, as a share of the image's shorter side."""

STEP_PX = 0.25
DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (0.5**0.5, 0.5**0.5), (0.5**0.5, -(0.5**0.5)))

KEPT_IMAGES = 4


class Resolution:
    """Measures how wide places are in the pixels of the thermal photos."""

    def __init__(self, render: SurfaceRenderer, survey: PhotoSurvey) -> None:
        self._survey = survey
        self._image = lru_cache(KEPT_IMAGES)(
            lambda photo: thermal_values(render(survey.cameras[photo]))  # normalised
        )

    def width_px(self, place: Sequence[float], sign: int, least: float) -> float:
        """Width of a hot (``sign`` 1) or a cold place (-1) at half its height, across its narrowest
        direction, in pixels of the photo that shows it largest; infinite where it does not stand
        out by ``least`` (normalised) on both sides, or no photo shows it."""
        largest = self._largest(place)
        if largest is None:
            return np.inf
        photo, x, y = largest
        image = sign * self._image(photo)
        row, column = int(y) - 1, int(x) - 1  # the largest of the nine pixels about
        down, right = np.unravel_index(image[row:, column:][:3, :3].argmax(), (3, 3))
        row, column = row + int(down), column + int(right)
        return min(_width(_profile(image, row, column, each), least) for each in DIRECTIONS)

    def side_of(self, place: Sequence[float]) -> int:
        """Whether a place is hotter (1) or colder (-1) than the median about it, in the photo that
        shows it largest; 0 where none shows it."""
        largest = self._largest(place)
        if largest is None:
            return 0
        photo, x, y = largest
        image = self._image(photo)
        about = image[square_about(image.shape[::-1], x, y)]
        return 1 if image[int(y), int(x)] >= np.median(about) else -1

    def _largest(self, place: Sequence[float]) -> tuple[int, float, float] | None:
        """Number in the survey of the photo with the smallest pixels at a place, of all that show
        it with its surroundings, and x and y of the place there."""
        point = np.array([place], np.float32)
        found, smallest = None, np.inf
        for number, item in self._survey.near(point):
            camera = self._survey.cameras[number]
            if not len(item.shown(point).rows):
                continue
            pixels, depth = camera.project(torch.from_numpy(point).double())
            (x, y), size = pixels[0].tolist(), float(depth[0] / camera.K[0, 0])
            inside = ABOUT_PX <= x < camera.width - ABOUT_PX
            if size < smallest and inside and ABOUT_PX <= y < camera.height - ABOUT_PX:
                found, smallest = (number, x, y), size
        return found


def square_about(size: tuple[int, int], x: float, y: float) -> tuple[slice, slice]:
    """Rows and columns around a pixel in an image of a width and a height, shifted into it."""
    side = max(8, round(SURROUNDINGS_SHARE * min(size)))
    left = min(max(round(x - side / 2), 0), size[0] - side)
    top = min(max(round(y - side / 2), 0), size[1] - side)
    return slice(top, top + side), slice(left, left + side)


def _profile(
    image: Float[np.ndarray, "h w"], row: int, column: int, direction: tuple[float, float]
) -> Float[np.ndarray, " s"]:
    """The values to both sides of a pixel along a direction (x, y), every ``STEP_PX``."""
    reach = ABOUT_PX - 2
    along = np.linspace(-reach, reach, 2 * round(reach / STEP_PX) + 1)
    at = [row + along * direction[1], column + along * direction[0]]
    values: Float[np.ndarray, " s"] = map_coordinates(image, at, order=1, mode="nearest")
    return values


def _width(profile: Float[np.ndarray, " s"], least: float) -> float:
    """Width of the peak in the middle of a profile at half its height over its higher side, px."""
    middle = len(profile) // 2
    sides = profile[middle::-1], profile[middle:]
    top, foot = profile[middle], max(side.min() for side in sides)
    if not top - foot >= least:  # nor where that is not known
        return np.inf
    half = 0.5 * (top + foot)
    return STEP_PX * sum(int(np.argmax(~(side > half))) for side in sides)
