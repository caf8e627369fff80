"""The part of a surface that belongs to a mark, as it is seen from where the mark was drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64, Shaped
from PIL import Image, ImageDraw

from mrgs.errors import ConfigError
from mrgs.marks.mark import Mark, Place
from mrgs.scene import THERMAL, Camera, Rendering
from mrgs.scene.camera import viewmat_towards
from mrgs.scene.depth_map import SurfaceRenderer
from mrgs.system.wording import Message

PROFILE_SAMPLES = 200

AREA_PX = 256
"""Longest side of an area or a line in the image that it is measured in."""

SPOT_PX = 12
"""Diameter of a spot in the image that it is measured in."""

MARGIN_PX = 3

FIELD_OF_VIEW = math.radians(50)
WIDEST_PX = 640
"""The image that a mark is measured in shows as much about it as a photo does, up to this width: in
a narrow one, large Gaussians with their centres outside are drawn otherwise than in the photos'
views, which the model is fitted to."""
WIDEST_SLOPE = 5.0
"""Tangent of the largest angle between the middle of a mark and its corners, seen from the eye."""

FEWEST_PIXELS = 12
"""Smallest number of pixels to fit a surface to."""

PICK_SHARE = 0.02
"""Half width of the pixels that a picked place is steadied with, as a share of the image's."""

SAME_SURFACE = 0.03
"""Pixels whose depth differs by less than this share are of one surface."""

STILL_THERE = 0.08
"""A surface whose depth differs by less than this share is the one that was marked: a model's
surface is off the object's, and a mark may be older than the model."""

BENT = 0.5
"""A corner may be off the plane of the others by this share of the outline's mean width, which
folds it by some 25°: the area of a rectangle with such a corner is off by 4 % at most."""

ROBUST_STEPS = 8
TUKEY = 6.0
"""Residual, in multiples of the median, from which on a point is ignored."""


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """A surface as one camera sees it. ``depth`` is z-depth in scene units, NaN where there is no
    surface, [H, W]."""

    camera: Camera
    rendering: Rendering
    depth: Float[np.ndarray, "h w"]

    @property
    def positions(self) -> Float[np.ndarray, "h w 3"]:
        """World coordinates of the surface at each pixel, NaN where there is none."""
        points: Float[np.ndarray, "h w 3"] = self.camera.unproject_image(
            torch.from_numpy(self.depth)
        ).numpy()
        return points


class PixelPlaces(NamedTuple):
    """Pixels of an image at which points of the world appear; row and column are 0 outside."""

    rows: Int64[np.ndarray, " n"]
    columns: Int64[np.ndarray, " n"]
    inside: Bool[np.ndarray, " n"]


def see(render: SurfaceRenderer, camera: Camera) -> SeenSurface:
    """Render the surface that a camera sees."""
    rendering = render(camera)
    return SeenSurface(camera, rendering, seen_depth(rendering))


def seen_depth(rendering: Rendering) -> Float[np.ndarray, "h w"]:
    """z-depth of the visible surface (``Rendering.visible_depth``) in double precision, [H, W]."""
    return rendering.visible_depth().cpu().double().numpy()


CHECKED_POINTS = 64
"""Number of points of a mark by which photos count as seeing it."""


def checked_points(places: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "m 3"]:
    """Places of a mark by which photos count as seeing it."""
    return places[:: -(-len(places) // CHECKED_POINTS)].astype(np.float32)


def thermal_values(rendering: Rendering) -> Float[np.ndarray, "h w"]:
    """The normalised thermal image in double precision, [H, W]."""
    values: Float[np.ndarray, "h w"] = rendering[THERMAL].image[..., 0].cpu().double().numpy()
    return values


def measuring_camera(mark: Mark) -> Camera:
    """The camera that a mark is measured with: at its eye, towards its middle, and about as wide
    as a photo; ConfigError if the mark is around its eye, so that no camera sees all of it."""
    points, eye = np.array(mark.points), np.array(mark.eye)
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    forward = target - eye
    distance = np.linalg.norm(forward)
    if not distance > 0:
        raise ConfigError("a mark must not lie where it was drawn from")
    upright = abs(forward[2]) < 0.99 * distance
    viewmat = viewmat_towards(eye, target, [0.0, 0.0, 1.0] if upright else [0.0, 1.0, 0.0])
    in_camera = (points - eye) @ viewmat[:3, :3].numpy().T
    slopes = np.abs(in_camera[:, :2] / np.maximum(in_camera[:, 2:], 1e-12))
    if not in_camera[:, 2].min() > 0 or not slopes.max() <= WIDEST_SLOPE:
        raise ConfigError(
            Message(
                "{name} is too wide to be seen at once: draw it from farther away", name=mark.name
            )
        )
    pixels, reach = AREA_PX, slopes.max()
    if mark.kind == "spot":
        pixels, reach = SPOT_PX, mark.radius / np.linalg.norm(points[0] - eye)
    focal = 0.5 * pixels / max(float(reach), 1e-9)
    around = min(round(2 * focal * math.tan(FIELD_OF_VIEW / 2)), WIDEST_PX)
    size = max(pixels + 2 * MARGIN_PX, around)
    K = [[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]]
    return Camera(K, viewmat, size, size)


def pixels_of(camera: Camera, points: Float[np.ndarray, "n 3"]) -> PixelPlaces:
    """The pixels at which points of the world appear."""
    places, _ = camera.project(torch.from_numpy(np.asarray(points, dtype=np.float64)))
    inside = camera.contains(places).numpy()
    columns, rows = np.where(inside[:, None], places.numpy(), 0).astype(np.int64).T
    return PixelPlaces(rows, columns, inside)


def line_samples(mark: Mark) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, " s"]]:
    """Evenly spaced points on the straight pieces of a line, [S, 3], and their distances from its
    first point, [S]."""
    corners = np.array(mark.points)
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    ends = np.concatenate([[0.0], np.cumsum(steps)])
    distances = np.linspace(0.0, ends[-1], PROFILE_SAMPLES)
    points = np.stack([np.interp(distances, ends, corners[:, i]) for i in range(3)], axis=1)
    return points, distances


def marked_pixels(surface: SeenSurface, mark: Mark) -> PixelPlaces:
    """The pixels of a spot or an area, or of the samples of a line."""
    if mark.kind == "line":
        return pixels_of(surface.camera, line_samples(mark)[0])
    camera = surface.camera
    if mark.kind == "spot":
        mask = disc_mask(camera, surface.depth, np.array(mark.points[0]), mark.radius)
    else:
        mask = outline_mask(camera, mark.points)
    rows, columns = np.nonzero(mask)
    return PixelPlaces(rows, columns, np.ones(len(rows), bool))


def outline_mask(camera: Camera, points: Sequence[Place]) -> Bool[np.ndarray, "h w"]:
    """The pixels whose centres lie within the outline of a mark, [H, W]."""
    pixels, _ = camera.project(torch.tensor(points, dtype=torch.float64))
    image = Image.new("1", (camera.width, camera.height))
    corners = [(x - 0.5, y - 0.5) for x, y in pixels.tolist()]
    ImageDraw.Draw(image).polygon(corners, fill=1)
    return np.asarray(image)


def disc_mask(
    camera: Camera, depth: Float[np.ndarray, "h w"], place: Float[np.ndarray, "3"], radius: float
) -> Bool[np.ndarray, "h w"]:
    """The pixels of an image of z-depths that show the surface of a place within a radius of it,
    [H, W]; none where the model no longer has it."""
    pixel, z = (each.numpy() for each in camera.project(torch.from_numpy(place)))
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    inside = np.hypot(columns - pixel[0], rows - pixel[1]) <= radius * camera.K[0, 0].item() / z
    inside &= np.abs(depth - z) < STILL_THERE * z
    if not inside.any():
        return inside
    middle = np.median(depth[inside])
    mask: Bool[np.ndarray, "h w"] = inside & (np.abs(depth - middle) < SAME_SURFACE * middle)
    return mask


def outline_area(points: Sequence[Place]) -> float:
    """Area of the flat outline through corners, scene units squared; of one that is not flat, that
    of its projection along its mean normal (Newell)."""
    corners = np.array(points)
    corners = corners - corners.mean(axis=0)
    return 0.5 * float(np.linalg.norm(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)))


def has_flat_outline(mark: Mark) -> bool:
    """Whether the corners of a mark lie in one plane, so that its flat outline has an area: each
    within ``BENT`` of the outline's mean width off the plane of the others alone, which it would
    tilt, or within what counts as one surface from where it was drawn."""
    corners = np.array(mark.points)
    if len(corners) < 4:
        return True
    length = np.linalg.norm(corners[:, None] - corners, axis=2).max()
    width = outline_area(mark.points) / max(float(length), 1e-300)
    within = SAME_SURFACE * np.linalg.norm(corners - np.array(mark.eye), axis=1)
    off = [_off_plane(corners, index) for index in range(len(corners))]
    return bool(np.all(np.array(off) <= np.maximum(within, BENT * width)))


def _off_plane(corners: Float[np.ndarray, "n 3"], index: int) -> float:
    """Distance of a corner from the plane that fits the others best; 0 where these are in a line,
    through which there is a plane with any corner."""
    others = np.delete(corners, index, axis=0)
    middle = others.mean(axis=0)
    _, lengths, axes = np.linalg.svd(others - middle)
    if lengths[1] < 1e-6 * max(lengths[0], 1e-300):
        return 0.0
    return abs(float((corners[index] - middle) @ axes[2]))


def window_about(
    middle: tuple[int, int], reach: int, shape: tuple[int, ...]
) -> tuple[np.ndarray, ...]:
    """The rows and the columns of an image about a pixel."""
    near = zip(middle, shape, strict=True)
    return tuple(np.arange(max(at - reach, 0), min(at + reach + 1, size)) for at, size in near)


def steady_depth(surface: SeenSurface, x: float, y: float) -> float:
    """z-depth of the surface at a place of the image, from the pixels about it: a single pixel has
    the depth of one splat. NaN where there is no surface."""
    row, column = int(y), int(x)
    here = surface.depth[row, column]
    reach = max(3, round(PICK_SHARE * max(surface.depth.shape)))
    rows, columns = window_about((row, column), reach, surface.depth.shape)
    depth = surface.depth[np.ix_(rows, columns)]
    grid = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    near = np.abs(depth - here) < SAME_SURFACE * here  # false for NaN
    if near.sum() < FEWEST_PIXELS:
        return float(here)
    rays = rays_of(surface.camera, *grid[near].T)
    wanted = rays_of(surface.camera, np.array([y - 0.5]), np.array([x - 0.5]))[0]
    return float(1 / max(float(wanted @ fitted_plane(rays, depth[near])), 1e-12))


def fitted_plane(
    rays: Float[np.ndarray, "n 3"], depth: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "3"]:
    """The plane through most of the z-depths on rays (x / z, y / z, 1), as the vector whose product
    with each of its points is 1, in the camera's axes.

    The inverse depth of a plane is linear in x and y. Outliers do not count (Tukey's weights).
    """
    inverse, weights = 1 / depth, np.ones(len(depth))
    for _ in range(ROBUST_STEPS):
        root = np.sqrt(weights)
        plane: Float[np.ndarray, "3"] = np.linalg.lstsq(
            rays * root[:, None], inverse * root, rcond=None
        )[0]
        weights = tukey_weights(np.abs(inverse - rays @ plane), 1e-12 * float(inverse.max()))
    return plane


def tukey_weights(left: Float[np.ndarray, " n"], least: float = 1e-12) -> Float[np.ndarray, " n"]:
    """Tukey's biweights of absolute residuals; their median counts as no less than ``least``."""
    scale = max(float(np.median(left)), least)
    weights: Float[np.ndarray, " n"] = np.square(
        np.maximum(1 - np.square(left / (TUKEY * scale)), 0.0)
    )
    return weights


def rays_of(
    camera: Camera, rows: Shaped[np.ndarray, " n"], columns: Shaped[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """(x / z, y / z, 1) of pixels, in the camera's axes."""
    fx, fy, cx, cy = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return np.stack([(columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones(len(rows))], axis=1)
