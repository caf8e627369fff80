"""Refinement of a first guess: patches are matched, cameras adjusted, from coarse to fine."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn import functional

from mrgs.data.undistort import sampled
from mrgs.errors import SceneError
from mrgs.prepare.contract import Progress
from mrgs.prepare.rig.adjust import Adjusted, Observations, Prior, ThermalCameras, adjust
from mrgs.prepare.rig.contract import FEWEST_MATCHES
from mrgs.prepare.rig.images import STEP_PX, ReducedPair, structure
from mrgs.scene.lens import Lens

_BORDER_PX = 3
_WHOLE_STEP_PX = 2
_LEAST_SEEN = 0.7
_LEAST_SCORE = 0.3
_MOST_STEP_PX = 1.0
_LEAST_CURVATURE = 1e-5


@dataclass(frozen=True)
class Patches:
    """The layout of the patches, in pixels of the compared images: the σ of the Gaussian window,
    the spacing of the centres, and the largest displacement that is searched, in x and in y."""

    sigma: float
    spacing: int
    reach: int

    @property
    def independent(self) -> float:
        """Share of the patches with independent errors, because neighbouring windows overlap."""
        return min(1.0, self.spacing**2 / (4 * np.pi * self.sigma**2))


@dataclass(frozen=True, eq=False)
class Masked:
    """The structure of an image, and the mask of its valid pixels; None if all are."""

    values: Float32[np.ndarray, "c h w"]
    seen: Bool[np.ndarray, "h w"] | None = None

    def within_border(self) -> tuple[Float32[Tensor, "c h w"], Float32[Tensor, "h w"]]:
        """The structure, 0 where not valid or near the border; and that mask as 0 and 1."""
        mask = torch.zeros(self.values.shape[1:])
        inner = (slice(_BORDER_PX, -_BORDER_PX), slice(_BORDER_PX, -_BORDER_PX))
        mask[inner] = 1.0 if self.seen is None else torch.from_numpy(self.seen[inner]).float()
        return torch.from_numpy(self.values) * mask, mask


class Matches(NamedTuple):
    """M matched patches: column and row of the centre in the photo's image (whole numbers, between
    four pixels), the displacement from there to the matching position in the thermal image, its
    inverse covariance up to a common factor, and the normalised correlation."""

    centres: Float[np.ndarray, "m 2"]
    displacements: Float[np.ndarray, "m 2"]
    information: Float[np.ndarray, "m 2 2"]
    scores: Float[np.ndarray, " m"]

    def sharpest(self, share: float) -> Matches:
        """The share of the patches whose positions are the most certain."""
        if not len(self.scores):
            return self
        sharpness = np.trace(self.information, axis1=1, axis2=2)
        kept = sharpness >= np.quantile(sharpness, 1 - share)
        return Matches(*(values[kept] for values in self))


def match(thermal: Masked, photo: Masked, patches: Patches) -> Matches:
    """Match each patch by normalised correlation of the two structures, over the overlap at each
    displacement (else the border would bias the focal length), to a fraction of a pixel; a patch
    without a maximum within reach is left out. The information is the curvature of the correlation
    s at its maximum times s / (1 - s²), as if independent noise alone kept it from being 1."""
    scores, share, columns, rows = _scores(thermal, photo, patches)
    ny, nx = share.shape
    flat = scores.reshape(scores.shape[0], scores.shape[1], ny * nx).transpose(2, 0, 1)
    best = flat.reshape(ny * nx, -1).argmax(axis=1)
    i, j = np.unravel_index(best, flat.shape[1:])
    side = 2 * patches.reach + 1
    usable = (share.ravel() > _LEAST_SEEN) & (i > 0) & (i < side - 1) & (j > 0) & (j < side - 1)
    usable &= flat[np.arange(ny * nx), i, j] > _LEAST_SCORE
    kept = np.flatnonzero(usable)
    i, j = i[kept], j[kept]
    across = np.arange(-1, 2)
    around = flat[
        kept[:, None, None], i[:, None, None] + across[:, None], j[:, None, None] + across
    ]
    step, curvature = _vertex(around)
    score = np.minimum(around[:, 1, 1], 0.999).astype(np.float64)
    sharp = np.linalg.eigvalsh(curvature)[:, 0] > _LEAST_CURVATURE
    centres = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)[kept].astype(np.float64)
    displacements = np.column_stack([j, i]) - patches.reach + step
    information = curvature * (score / (1 - score**2))[:, None, None]
    return Matches(centres[sharp], displacements[sharp], information[sharp], score[sharp])


def whole_displacement(thermal: Masked, photo: Masked, reach: int) -> tuple[int, int]:
    """Displacement of the whole thermal image, pixels right and down: the best normalised
    correlation within ``reach`` pixels, in steps of ``_WHOLE_STEP_PX``."""
    steps = range(-(reach // _WHOLE_STEP_PX) * _WHOLE_STEP_PX, reach + 1, _WHOLE_STEP_PX)
    places = [(right, down) for down in steps for right in steps]
    scores = list(_correlations(thermal, photo, reach, places, lambda values: values.sum()))
    return places[int(torch.stack(scores).argmax())]


def _correlations(
    thermal: Masked,
    photo: Masked,
    reach: int,
    places: Iterable[tuple[int, int]],
    pooled: Callable[[Tensor], Tensor],
) -> Iterator[Tensor]:
    """Normalised correlations at displacements right and down of the thermal image, over the pixels
    that overlap; ``pooled`` sums parts of an image."""
    here, here_seen = photo.within_border()
    there, there_seen = (functional.pad(values, 4 * [reach]) for values in thermal.within_border())
    here_energy, there_energy = here.square().sum(dim=0), there.square().sum(dim=0)
    height, width = here_seen.shape
    for right, down in places:
        top, left = reach + down, reach + right
        part = (..., slice(top, top + height), slice(left, left + width))
        norm = pooled(there_energy[part] * here_seen) * pooled(here_energy * there_seen[part])
        yield pooled((there[part] * here).sum(dim=0)) / (norm + 1e-9).sqrt()


def _scores(
    thermal: Masked, photo: Masked, patches: Patches
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Correlations [displacement y, displacement x, patch row, patch column], the share of each
    patch that is seen, and the patches' columns and rows."""
    _, height, width = photo.values.shape
    margin = round(1.5 * patches.sigma)
    rows, columns = (np.arange(margin, n - margin + 1, patches.spacing) for n in (height, width))
    across, down = _windows(width, columns, patches.sigma), _windows(height, rows, patches.sigma)

    def pooled(values: Tensor) -> Tensor:
        return down @ values @ across.T

    reach, side = patches.reach, 2 * patches.reach + 1
    places = [
        (right, down) for down in range(-reach, reach + 1) for right in range(-reach, reach + 1)
    ]
    scores = torch.stack([*_correlations(thermal, photo, reach, places, pooled)])
    _, seen = photo.within_border()
    share = pooled(seen) / pooled(torch.ones_like(seen))
    return scores.reshape(side, side, *share.shape).numpy(), share.numpy(), columns, rows


def _windows(count: int, centres: np.ndarray, sigma: float) -> Float32[Tensor, "k n"]:
    offsets = (np.arange(count) + 0.5 - centres[:, None]) / sigma
    weights = np.where(np.abs(offsets) < 2, np.exp(-0.5 * offsets**2), 0.0)
    return torch.from_numpy(weights.astype(np.float32))


def _vertex(
    around: Float[np.ndarray, "m 3 3"],
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2 2"]]:
    """Maximum (x, y) of the parabola through 3×3 values, from the middle; its negated Hessian."""
    a = around.astype(np.float64)
    slope = np.column_stack([a[:, 1, 2] - a[:, 1, 0], a[:, 2, 1] - a[:, 0, 1]]) / 2
    xx = 2 * a[:, 1, 1] - a[:, 1, 2] - a[:, 1, 0]
    yy = 2 * a[:, 1, 1] - a[:, 2, 1] - a[:, 0, 1]
    xy = (a[:, 0, 2] + a[:, 2, 0] - a[:, 2, 2] - a[:, 0, 0]) / 4
    curvature = np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)
    safe = curvature + np.eye(2) * 1e-6
    step = np.linalg.solve(safe, slope[..., None])[..., 0]
    return np.clip(step, -_MOST_STEP_PX, _MOST_STEP_PX), curvature


_SHARPEST = 0.5
"""Share of a pair's patches that is used: faint ones match by chance, or follow a moving shadow."""

_FARTHEST_WIDTHS = 0.1
"""Largest displacement of a pair from the first guess, in image widths: the error of the rig, and
motion between the shutters."""


@dataclass(frozen=True)
class Level:
    """A level of the refinement: thermal width, blur of the structure, layout of the patches."""

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
    report: Progress,
    corners: Observations | None = None,
) -> tuple[Adjusted, Observations]:
    """The cameras that fit all pairs best, and the observations of the last level. SceneError if
    hardly any patch is matched. ``size`` is that of the thermal files; the initial cameras agree
    with the ``corners`` of a target."""
    width = pairs[0].thermal.values.shape[1]
    levels = [level for level in LEVELS if level.width_px <= width] or [LEVELS[0]]
    done, total = itertools.count(), (len(levels) + 1) * len(pairs)

    def compared(level: Level) -> Iterator[_ComparedPair]:
        for pair in _compared(pairs, size, cameras, level):
            report("matching", next(done), total)
            yield pair

    known = set() if corners is None else set(corners.views.tolist())
    cameras = _shifted(compared(levels[0]), cameras, known)
    for level in levels:
        observations = _observe(compared(level), level.patches)
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


class _ComparedPair(NamedTuple):
    """A pair at a level: the photo warped to the thermal camera, the structures of both images, and
    thermal file pixels per compared pixel."""

    warped: Warped
    thermal: Masked
    photo: Masked
    scale: float


def _compared(
    pairs: Sequence[ReducedPair], size: tuple[int, int], cameras: ThermalCameras, level: Level
) -> Iterator[_ComparedPair]:
    """The pairs with the current cameras."""
    lens = cameras.lens(*size)
    width = min(level.width_px, pairs[0].thermal.values.shape[1])
    height = max(1, round(size[1] * width / size[0]))
    rays, scale = thermal_rays(lens, width, height), size[0] / width
    for view, pair in enumerate(pairs):
        thermal_from_photo = cameras.correction(view) @ cameras.extrinsics()
        spacing = pair.camera.K[0, 0].item() * scale / lens.fx
        warped = warp(pair, rays, torch.linalg.inv(thermal_from_photo).numpy(), spacing)
        thermal = pair.thermal.resized(width, height)
        yield _ComparedPair(
            warped,
            Masked(structure(thermal.values, level.blur_px, thermal.valid), thermal.valid),
            Masked(structure(warped.values, level.blur_px, warped.seen), warped.seen),
            scale,
        )


def _shifted(
    compared: Iterable[_ComparedPair], cameras: ThermalCameras, known: set[int]
) -> ThermalCameras:
    """Each camera, except the known ones, rotated so that its whole image is aligned: patches alone
    would lose pairs that are far off."""
    motions, focal_px = cameras.motions.clone(), float(cameras.rig[0].exp())
    for view, pair in enumerate(compared):
        if view in known:
            continue
        reach = round(_FARTHEST_WIDTHS * pair.photo.values.shape[2])
        right, down = whole_displacement(pair.thermal, pair.photo, reach)
        motions[view, :2] += (
            torch.tensor([-down, right], dtype=torch.float64) * pair.scale / focal_px
        )
    return ThermalCameras(cameras.rig, motions)


def _observe(compared: Iterable[_ComparedPair], patches: Patches) -> Observations:
    """Match the patches of all pairs."""
    found: list[tuple[Tensor, ...]] = []
    for view, pair in enumerate(compared):
        matches = match(pair.thermal, pair.photo, patches).sharpest(_SHARPEST)
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
    independent = torch.full((len(views),), patches.independent, dtype=torch.float64)
    return Observations(views, points, pixels, information, independent, torch.zeros_like(views))


_ITERATIONS = 6


class Warped(NamedTuple):
    """A photo on the thermal camera's pixel grid: luma, the surface point of each pixel in the axes
    of the photo's camera, and whether the photo shows it."""

    values: Float32[np.ndarray, "h w"]
    points: Float[np.ndarray, "h w 3"]
    seen: Bool[np.ndarray, "h w"]


def thermal_rays(lens: Lens, width: int, height: int) -> Float[np.ndarray, "h w 3"]:
    """The ray (x, y, 1) of each thermal pixel, if the image is resized to width × height."""
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
    inside = (u > 1) & (u < pair.camera.width - 1) & (v > 1) & (v < pair.camera.height - 1)
    seen = ahead & (along > 0) & inside
    if pair.photo.valid is not None:
        seen &= sampled(pair.photo.valid.astype(np.float32), u, v) > 0.99
    photo = pair.photo.values
    if spacing > 1:
        photo = gaussian_filter(photo, 0.5 * np.sqrt(spacing**2 - 1))
    return Warped(sampled(photo, u, v).astype(np.float32), points, seen)
