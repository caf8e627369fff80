"""Refinement of a first guess: patches are matched and the cameras adjusted, from coarse to
fine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import gaussian_filter
from torch import Tensor

from mrgs.data.lens import Lens
from mrgs.data.undistort import sampled
from mrgs.errors import SceneError
from mrgs.prepare.rig.adjust import Adjusted, Observations, Prior, ThermalCameras, adjust
from mrgs.prepare.rig.images import STEP_PX, ReducedPair, structure
from mrgs.prepare.rig.matching import Masked, Patches, match, whole_displacement

FEWEST_MATCHES = 12
_SHARPEST = 0.5
"""Share of a pair's patches that is used: faint ones match by chance, or follow a moving shadow."""

_FARTHEST_WIDTHS = 0.1
"""Largest displacement of a pair from the first guess, in image widths: the error of the rig, and
motion between the shutters."""


@dataclass(frozen=True)
class Level:
    """A level of the refinement: the width of the thermal images, the blur of their structure, and
    the layout of the patches."""

    width_px: int
    blur_px: float
    patches: Patches


LEVELS = (
    Level(160, 1.5, Patches(sigma=10, spacing=10, reach=6)),
    Level(160, 1.5, Patches(sigma=10, spacing=10, reach=4)),
    Level(160, 1.5, Patches(sigma=10, spacing=10, reach=4)),
    Level(320, 2.0, Patches(sigma=16, spacing=16, reach=5)),
    Level(320, 2.0, Patches(sigma=16, spacing=16, reach=4)),
)


def refine(
    pairs: Sequence[ReducedPair],
    size: tuple[int, int],
    cameras: ThermalCameras,
    prior: Prior,
    report: Callable[[str, int, int], None],
    corners: Observations | None = None,
) -> tuple[Adjusted, Observations]:
    """The cameras that fit all pairs best, and the observations of the last level.

    Args:
        size: width and height of the thermal files.
        report: called with a step's name, the number of its parts that are done, and of all.
        corners: of a target, with which the initial cameras agree.

    Raises:
        SceneError: hardly any patch is matched.
    """
    width = pairs[0].thermal.values.shape[1]
    levels = [level for level in LEVELS if level.width_px <= width] or [LEVELS[0]]
    known = set() if corners is None else set(corners.views.tolist())
    passes = len(levels) + 1

    def of_pass(number: int) -> Callable[[int], None]:
        done, total = number * len(pairs), passes * len(pairs)
        return lambda view: report("matching", done + view, total)

    cameras = _shifted(pairs, size, cameras, levels[0], known, of_pass(0))
    for number, level in enumerate(levels, start=1):
        observations = _observe(pairs, size, cameras, level, of_pass(number))
        if corners is not None:
            observations = Observations.joined([observations, corners])
        if len(observations.views) < FEWEST_MATCHES:
            raise SceneError(
                "the thermal camera cannot be placed: hardly any patch of the photos is found in "
                "the thermal images; give the thermal camera's lens and offset",
                options=("thermal_camera",),
            )
        adjusted = adjust(observations, prior, cameras)
        cameras = adjusted.cameras
    return adjusted, observations


@dataclass(frozen=True, eq=False)
class _ComparedPair:
    """A pair at a level: the photo warped to the thermal camera, and the structures of both
    images."""

    warped: Warped
    thermal: Masked
    photo: Masked
    scale: float


def _compared(
    pairs: Sequence[ReducedPair],
    size: tuple[int, int],
    cameras: ThermalCameras,
    level: Level,
    report: Callable[[int], None],
) -> Iterator[_ComparedPair]:
    """The pairs with the current cameras; ``scale`` is thermal file pixels per compared pixel, and
    ``report`` is called with the number of each pair."""
    lens = cameras.lens(*size)
    width = min(level.width_px, pairs[0].thermal.values.shape[1])
    height = max(1, round(size[1] * width / size[0]))
    rays, scale = thermal_rays(lens, width, height), size[0] / width
    for view, pair in enumerate(pairs):
        report(view)
        photo_from_thermal = torch.linalg.inv(
            cameras.correction(view) @ cameras.extrinsics()
        ).numpy()
        warped = warp(pair, rays, photo_from_thermal, pair.camera.K[0, 0].item() * scale / lens.fx)
        thermal = pair.thermal.resized(width, height)
        yield _ComparedPair(
            warped,
            Masked(structure(thermal.values, level.blur_px, thermal.valid), thermal.valid),
            Masked(structure(warped.values, level.blur_px, warped.seen), warped.seen),
            scale,
        )


def _shifted(
    pairs: Sequence[ReducedPair],
    size: tuple[int, int],
    cameras: ThermalCameras,
    level: Level,
    known: set[int],
    report: Callable[[int], None],
) -> ThermalCameras:
    """Each camera, except the known ones, rotated so that its whole image is aligned: patches alone
    would lose pairs that are far off."""
    fx, motions = cameras.lens(*size).fx, cameras.motions.clone()
    for view, pair in enumerate(_compared(pairs, size, cameras, level, report)):
        if view in known:
            continue
        reach = round(_FARTHEST_WIDTHS * pair.photo.values.shape[2])
        right, down = whole_displacement(pair.thermal, pair.photo, reach)
        motions[view, :2] += torch.tensor([-down, right], dtype=torch.float64) * pair.scale / fx
    return ThermalCameras(cameras.rig, motions)


def _observe(
    pairs: Sequence[ReducedPair],
    size: tuple[int, int],
    cameras: ThermalCameras,
    level: Level,
    report: Callable[[int], None],
) -> Observations:
    """Match the patches of all pairs."""
    found: list[tuple[Tensor, ...]] = []
    for view, pair in enumerate(_compared(pairs, size, cameras, level, report)):
        matches = match(pair.thermal, pair.photo, level.patches).sharpest(_SHARPEST)
        column, row = matches.centres.astype(int).T
        corners = [
            pair.warped.points[row - down, column - right] for down in (0, 1) for right in (0, 1)
        ]
        found.append(
            (
                torch.full((len(column),), view),
                torch.from_numpy(np.mean(corners, axis=0).reshape(-1, 3)),
                torch.from_numpy((matches.centres + matches.displacements) * pair.scale),
                torch.from_numpy(matches.information / pair.scale**2),
            )
        )
    views, points, pixels, information = (torch.cat(parts) for parts in zip(*found, strict=True))
    independent = torch.full((len(views),), level.patches.independent, dtype=torch.float64)
    return Observations(views, points, pixels, information, independent, torch.zeros_like(views))


_ITERATIONS = 6


@dataclass(frozen=True, eq=False)
class Warped:
    """A photo on the thermal camera's pixel grid.

    Attributes:
        values: the photo's luma.
        points: surface point of each pixel [H, W, 3], in the axes of the photo's camera.
        seen: whether the photo shows it.
    """

    values: Float32[np.ndarray, "h w"]
    points: Float[np.ndarray, "h w 3"]
    seen: Bool[np.ndarray, "h w"]


def thermal_rays(lens: Lens, width: int, height: int) -> Float[np.ndarray, "h w 3"]:
    """The ray (x, y, 1) of each pixel of the thermal image, when it is resized to width ×
    height."""
    u, v = np.meshgrid(
        (np.arange(width) + 0.5) * lens.width / width,
        (np.arange(height) + 0.5) * lens.height / height,
    )
    x, y = lens.undistort((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def warp(
    pair: ReducedPair,
    rays: Float[np.ndarray, "h w 3"],
    photo_from_thermal: Float[np.ndarray, "4 4"],
    spacing: float,
) -> Warped:
    """The photo warped to the thermal camera's grid.

    The intersection of each ray with the photo's surfaces is found by fixed-point iteration: the
    point of the ray at the current depth, and the photo's depth at its projection.

    Args:
        rays: of the thermal pixels, from ``thermal_rays``.
        photo_from_thermal: rigid motion [4, 4] from the thermal camera's axes to the photo's.
        spacing: of the thermal pixels, in photo pixels; the photo is blurred accordingly.
    """
    directions = np.einsum("ij,hwj->hwi", photo_from_thermal[:3, :3], rays)
    centre = photo_from_thermal[:3, 3]
    fx, fy, cx, cy = pair.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    inverse: Float[np.ndarray, "h w"] = np.full(rays.shape[:2], pair.depth.median)
    ahead = directions[..., 2] > 0.1
    depth_along = np.where(ahead, directions[..., 2], 1.0)
    for _ in range(_ITERATIONS):
        along = (1 / np.maximum(inverse, 1e-9) - centre[2]) / depth_along
        points = centre + along[..., None] * directions
        u, v = fx * points[..., 0] / points[..., 2] + cx, fy * points[..., 1] / points[..., 2] + cy
        inverse = sampled(pair.depth.values, u, v, STEP_PX)
    seen = (
        ahead
        & (along > 0)
        & (u > 1)
        & (u < pair.camera.width - 1)
        & (v > 1)
        & (v < pair.camera.height - 1)
    )
    if pair.photo.valid is not None:
        seen &= sampled(pair.photo.valid.astype(np.float32), u, v) > 0.99
    photo = pair.photo.values
    if spacing > 1:
        photo = gaussian_filter(photo, 0.5 * np.sqrt(spacing**2 - 1))
    return Warped(sampled(photo, u, v).astype(np.float32), points, seen)
