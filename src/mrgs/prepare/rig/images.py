"""The images of a pair at the working size of the calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import binary_erosion, gaussian_filter, uniform_filter
from scipy.spatial import ConvexHull, QhullError, cKDTree
from torch import Tensor

from mrgs.data.images import DRAFT_MARGIN, LUMINANCE
from mrgs.data.undistort import resize
from mrgs.errors import SceneError
from mrgs.prepare.rig.contract import RigPair
from mrgs.scene import Camera, Pixels

STEP_PX = 4
"""Photo pixels per value of the map; sparse points have no more detail."""

_BEND = 150.0
"""Curvature of the lifted surface: a hole of 5 % of the image's width, between points of a near
surface, is closed against points that are more than about 10 % farther away."""

_NEAR_SURFACE = 0.06
_NEIGHBOURS = 9
_OUTLIER = 0.1
_MOST_POINTS = 6000
FEWEST_POINTS = 8


@dataclass(frozen=True, eq=False)
class InverseDepth:
    """Inverse depth 1 / z over a photo, one value per ``STEP_PX`` photo pixels; and the median of
    the points that the photo sees."""

    values: Float[np.ndarray, "rows columns"]
    median: float


def inverse_depth(
    points: Float[np.ndarray, "n 3"], camera: Camera, visible: Int[np.ndarray, " k"] | None = None
) -> InverseDepth | None:
    """The inverse depth of a photo, interpolated between the points that it sees; None if they are
    too few. ``points`` are in world coordinates; ``visible`` are those that the photo sees, None to
    find hidden ones by their depth."""
    pixels, depth = camera.project(points if visible is None else points[visible])
    seen = camera.contains(pixels)
    uv, first = np.unique(pixels[seen].numpy(), axis=0, return_index=True)
    inverse = 1.0 / depth[seen].numpy()[first]
    if len(uv) < FEWEST_POINTS:
        return None
    if visible is None:
        uv, inverse = _unhidden(uv, inverse, camera.width)
    _, nearest = cKDTree(uv).query(uv, k=min(_NEIGHBOURS, len(uv)))
    usual = np.median(inverse[nearest], axis=1)
    kept = np.abs(inverse - usual) < _OUTLIER * usual
    uv, inverse = uv[kept], inverse[kept]
    if len(uv) < FEWEST_POINTS:
        return None
    every = -(-len(uv) // _MOST_POINTS)
    values = _interpolated(uv[::every], inverse[::every], camera)
    return InverseDepth(values, float(np.median(inverse)))


def _unhidden(
    uv: Float[np.ndarray, "n 2"], inverse: Float[np.ndarray, " n"], width: int
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    """The points that no surface through nearer points hides, by Katz, Tal and Basri (2007), in the
    image: inverse depth is lifted by a paraboloid; what lies on the upper convex hull, or just
    under the surface through it, is visible."""
    radius2 = ((uv / width) ** 2).sum(axis=1)
    lifted = np.column_stack([uv / width, inverse / np.quantile(inverse, 0.9) - _BEND * radius2])
    try:
        hull = ConvexHull(lifted)
    except QhullError:  # all in one plane: nothing hides anything
        return uv, inverse
    front = np.unique(hull.simplices[hull.equations[:, 2] > 0])
    surface = LinearNDInterpolator(uv[front], inverse[front])(uv)
    seen = np.abs(inverse - surface) < _NEAR_SURFACE * surface
    seen[front] = True
    return uv[seen], inverse[seen]


def _interpolated(
    uv: Float[np.ndarray, "n 2"], inverse: Float[np.ndarray, " n"], camera: Camera
) -> Float[np.ndarray, "rows columns"]:
    """Linear between the points, that of the nearest point beyond them."""
    sides = (camera.width, camera.height)
    grid = np.meshgrid(*(np.arange(STEP_PX / 2, side, STEP_PX) for side in sides))
    values = NearestNDInterpolator(uv, inverse)(*grid)
    try:
        between = LinearNDInterpolator(uv, inverse)(*grid)
    except QhullError:  # all on one line
        return values
    return np.where(np.isnan(between), values, between)


PHOTO_WIDTH_PX = 640
THERMAL_WIDTH_PX = 320
"""More pixels add nothing to images as soft as thermal ones, with patches matched to 0.1 px."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A grey image [H, W] and the mask of its usable pixels; None if all are."""

    values: Float32[np.ndarray, "h w"]
    valid: Bool[np.ndarray, "h w"] | None = None

    def resized(self, width: int, height: int) -> Plane:
        """The same field of view on another pixel grid, low-pass filtered if that is coarser."""
        valid = None if self.valid is None else torch.from_numpy(self.valid)
        values, valid = resize(torch.from_numpy(self.values)[..., None], valid, width, height)
        return Plane(values[..., 0].numpy(), None if valid is None else valid.numpy())


@dataclass(frozen=True, eq=False)
class ReducedPair:
    """A pair at working size: the luma of the photo, its camera and depth, and the thermal image
    with lens distortion."""

    name: str
    photo: Plane
    camera: Camera
    depth: InverseDepth
    thermal: Plane


def reduced_pair(
    pair: RigPair, points: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "k 3"]
) -> tuple[ReducedPair | None, tuple[int, int]]:
    """The pair at working size, None if its photo sees too few of the scene's sparse points and a
    target's; and the thermal file's width and height. SceneError if an image cannot be read."""
    thermal = pair.load_thermal()
    height, width = thermal.values.shape[:2]
    camera = pair.photo.camera.at_most(PHOTO_WIDTH_PX)
    visible = None
    if pair.visible is not None:
        visible = np.append(pair.visible.numpy(), len(points) + np.arange(len(target)))
    depth = inverse_depth(np.concatenate([points, target]), camera, visible)
    if depth is None:
        return None, (width, height)
    photo = grey_plane(pair.photo.look(DRAFT_MARGIN * PHOTO_WIDTH_PX), pair.name)
    photo = photo.resized(camera.width, camera.height)
    reduced = min(THERMAL_WIDTH_PX, width)
    size = reduced, max(1, round(height * reduced / width))
    plane = grey_plane(thermal, pair.name).resized(*size)
    return ReducedPair(pair.name, photo, camera, depth, plane), (width, height)


def grey_plane(pixels: Pixels, name: str) -> Plane:
    """A photo's luma or only channel, unusable pixels the median; SceneError if all are."""
    values: Tensor = pixels.values
    grey = values[..., 0] if values.shape[-1] == 1 else (values * LUMINANCE).sum(dim=-1)
    valid = torch.isfinite(grey) if pixels.valid is None else pixels.valid & torch.isfinite(grey)
    if not valid.any():
        raise SceneError(f"no pixel of {name} can be used; remove the pair")
    filled = torch.where(valid, grey, grey[valid].median())
    return Plane(filled.numpy().astype(np.float32), None if valid.all() else valid.numpy())


DIRECTIONS = 6
_GRADIENT_SIGMA_PX = 1.0
_SURROUNDINGS_PX = 41
_MARGIN_PX = 4


def structure(
    image: Float[np.ndarray, "h w"], blur_px: float, valid: Bool[np.ndarray, "h w"] | None = None
) -> Float32[np.ndarray, "c h w"]:
    """Strength of the edges in each of ``DIRECTIONS``, less its mean around: the same for an
    inverted, scaled or shifted image. ``blur_px`` is where edges still correlate (σ of a Gaussian);
    the structure is 0 at and near pixels that are not ``valid``."""
    if valid is not None:
        image = np.where(valid, image, np.median(image[valid]) if valid.any() else 0.0)
    down, right = np.gradient(gaussian_filter(image.astype(np.float32), _GRADIENT_SIGMA_PX))
    angles = (np.arange(DIRECTIONS) * np.pi / DIRECTIONS).astype(np.float32)
    channels = np.abs(np.cos(angles)[:, None, None] * right + np.sin(angles)[:, None, None] * down)
    if valid is not None:
        channels *= binary_erosion(valid, iterations=_MARGIN_PX, border_value=1)
    channels = gaussian_filter(channels, (0, blur_px, blur_px))
    channels = (np.roll(channels, 1, axis=0) + 2 * channels + np.roll(channels, -1, axis=0)) / 4
    strength = np.sqrt((channels**2).sum(axis=0))
    channels /= strength + np.median(strength) + 0.1 * strength.mean() + np.float32(1e-12)
    return channels - uniform_filter(channels, (1, _SURROUNDINGS_PX, _SURROUNDINGS_PX))
