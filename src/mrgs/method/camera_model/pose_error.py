"""How far the pose of a view is off: the motion that aligns its photos with the renderings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from mrgs.method.camera_model.point_spread import blur
from mrgs.method.camera_model.pose_refinement import shift_per_motion
from mrgs.scene import Camera, Modality, Pixels, Rendering

COARSEST = 1 / 80
"""Both images are first smoothed by Gaussians of this share of the width, then by half of that, and
so on down to a pixel: errors that are larger than the details of an image are found in the coarser
ones. This is also the expected size of a motion; without evidence, the estimate is smaller."""

ROUNDS = 3
"""Steps of Gauss–Newton with each width."""

OUTLYING = 2.0
"""Standard deviations above which differences hardly count: they are not the camera's motion."""

LEAST_DEVIATION = 2e-3
"""Standard deviation of what differs where the images are even, as a share of their range."""

MOST_PIXELS = 10_000
"""Largest number of pixels that are used; of more every second, third, ... row and column."""

WRONG_PX = 0.3
"""Poses are wrong if photos are typically off by clearly more."""

WELL_SEEN = 4
"""Number of the six axes of a motion that show whether poses are wrong: those along which a view
shows most. Along the others, unfinished parts at a wrong depth look like a wrong pose."""

CLEARLY = 1.5
"""Ratio of what halves agree on to what they differ by from which on poses are wrong. To refine
poses that are right ruins a model; small errors that are not refined do less harm."""

UNCLEAR = 2.0
"""Ratio above which halves that differ give no evidence."""

SQUARE_PX = 16
"""Side of the squares that the two halves of an image consist of."""


class Alignable(NamedTuple):
    """A photo and the rendering that should look like it.

    Attributes:
        camera: of both.
        photo: from 0 to 1, [h, w, C].
        valid: which pixels of the photo count; None for all.
        rendering: as the camera writes it, [h, w, C].
        depth: z-depth of what is rendered in scene units, NaN where there is no surface.
    """

    camera: Camera
    photo: Float[Tensor, "h w c"]
    valid: Bool[Tensor, "h w"] | None
    rendering: Float[Tensor, "h w c"]
    depth: Float[Tensor, "h w"]

    @property
    def seen(self) -> Bool[Tensor, "h w"]:
        """Which pixels show a surface and count."""
        seen = self.depth.isfinite()
        return seen if self.valid is None else seen & self.valid


def alignables(
    cameras: Mapping[Modality, Camera],
    photos: Mapping[Modality, Pixels],
    rendering: Rendering,
    observed: Rendering,
) -> list[Alignable]:
    """The photos of a view whose rendering has a depth; ``observed`` is the rendering as the
    cameras would have recorded it."""
    return [
        Alignable(
            camera,
            photos[modality].values,
            photos[modality].valid,
            observed[modality].image,
            rendering.surface_depth(modality),
        )
        for modality, camera in cameras.items()
        if rendering.has_depth(modality)
    ]


@torch.no_grad()
def pose_error(
    images: Sequence[Alignable], centre: Float64[Tensor, "3"], axes_px: Float64[Tensor, "6 6"]
) -> Float64[Tensor, "6"]:
    """The small motion of the world that a view's cameras seem to have seen.

    Gauss–Newton on the differences of their values aligns the photos with the renderings, as in
    direct visual odometry (Lucas and Kanade 1981; Engel et al. 2018): a point that is rendered at
    the pixel u, at the depth z, is shown by the photo at u + J m. Each channel may be brighter or
    darker as a whole, and what differs much is left to other causes.

    Args:
        centre: of its first camera, about which the world is turned, in world coordinates.
        axes_px: columns of rotation vectors and translations, each of which shifts the images by
            about a pixel.

    Returns:
        m, along the axes, in pixels: its norm is about the root mean square of the shifts; 0 where
        it cannot be found.
    """
    motion = axes_px.new_zeros(6)
    places = [_places(image, centre, axes_px) for image in images]
    expected_px = max(2.0, COARSEST * images[0].camera.width)
    sigma_px = expected_px
    while sigma_px >= 1:
        samples = [
            _sampled(image, own, sigma_px) for image, own in zip(images, places, strict=True)
        ]
        for _ in range(ROUNDS):
            motion = motion + _correction(samples, motion, expected_px)
        sigma_px /= 2
    return torch.where(motion.isfinite().all(), motion, 0)


def halves_px(
    images: Sequence[Alignable], centre: Float64[Tensor, "3"], axes_px: Float64[Tensor, "6 6"]
) -> Float64[Tensor, "2 6"]:
    """``pose_error`` by either half of the images alone: the squares of a chessboard."""
    halves = [
        [each._replace(depth=_half(each.depth, which)) for each in images] for which in (0, 1)
    ]
    return torch.stack([pose_error(half, centre, axes_px) for half in halves])


class PoseAgreement(NamedTuple):
    """What the halves of typical photos show about their poses: medians over views.

    Attributes:
        agreed_px: how far a photo is off according to both.
        apart_px: how much the two differ.
    """

    agreed_px: float
    apart_px: float

    @property
    def is_wrong(self) -> bool:
        """Whether the poses are wrong: by what the halves agree on beyond what they differ by. A
        model that is not right differs from each half otherwise, a wrong pose from both alike."""
        clear = self.agreed_px > CLEARLY * self.apart_px
        return clear and self.agreed_px**2 - self.apart_px**2 > WRONG_PX**2

    @property
    def is_right(self) -> bool:
        """Whether they are right; a model that is not finished may leave it open."""
        return self.agreed_px <= WRONG_PX and self.apart_px <= UNCLEAR * WRONG_PX


def agreement(first: Float64[Tensor, "v 6"], second: Float64[Tensor, "v 6"]) -> PoseAgreement:
    """The agreement of the halves of some views, from their ``halves_px`` along axes in the order
    in which the views show least to most of a motion."""
    one, other = first[:, -WELL_SEEN:], second[:, -WELL_SEEN:]
    agreed = (one * other).sum(dim=1).median().item()
    return PoseAgreement(math.sqrt(max(0.0, agreed)), (one - other).norm(dim=1).median().item())


class _Places(NamedTuple):
    """Pixels of an image that show a surface and count in the photo.

    Attributes:
        centres: of the pixels, in the image.
        shifts: J, in pixels along the axes of the motion.
        step: from one pixel to the next, in each direction.
    """

    row: Int64[Tensor, " k"]
    column: Int64[Tensor, " k"]
    centres: Float64[Tensor, "k 2"]
    shifts: Float64[Tensor, "k 2 6"]
    step: int


class _Samples(NamedTuple):
    """Some pixels of an image, smoothed.

    Attributes:
        rendered: values and their slopes to the right and downwards, [k, C, 3].
        photo: the same of the whole photo, [C · 3, h, w].
        share: of independent ones among them: neighbours are smoothed together.
    """

    places: _Places
    rendered: Float64[Tensor, "k c 3"]
    photo: Float64[Tensor, "c3 h w"]
    share: float


def _places(
    image: Alignable, centre: Float64[Tensor, "3"], axes_px: Float64[Tensor, "6 6"]
) -> _Places:
    height, width, _ = image.photo.shape
    step = 1
    while height * width > MOST_PIXELS * step**2:
        step += 1
    row, column = image.seen[::step, ::step].nonzero().mul(step).unbind(1)
    centres = torch.stack([column, row], dim=1).double() + 0.5
    points = image.camera.unproject(centres, image.depth[row, column].double())
    shifts = shift_per_motion(image.camera, points, centre) @ axes_px
    focal = image.camera.K.diagonal()[:2].to(shifts)
    return _Places(row, column, centres, shifts * focal[:, None], step)


def _sampled(image: Alignable, places: _Places, sigma_px: float) -> _Samples:
    """What Gauss–Newton needs of an image."""
    photo = image.photo
    if image.valid is not None:
        photo = torch.where(image.valid[:, :, None], photo, image.rendering)
    rendered = _with_slopes(image.rendering, sigma_px)
    independent = 4 * torch.pi * sigma_px**2 / places.step**2
    return _Samples(
        places,
        rendered[:, :, places.row, places.column].movedim(2, 0),
        _with_slopes(photo, sigma_px).flatten(0, 1),
        1 / max(1.0, independent),
    )


def _with_slopes(image: Float[Tensor, "h w c"], sigma_px: float) -> Float64[Tensor, "c 3 h w"]:
    """A smoothed image and its slopes to the right and downwards."""
    sigma = torch.tensor(sigma_px, device=image.device)
    smooth = torch.stack([blur(channel, sigma) for channel in image.unbind(-1)]).double()
    down, right = torch.gradient(smooth, dim=(1, 2))
    return torch.stack([smooth, right, down], dim=1)


def _correction(
    samples: Sequence[_Samples], motion: Float64[Tensor, "6"], expected_px: float
) -> Float64[Tensor, "6"]:
    """A step of Gauss–Newton from a motion."""
    precision = torch.eye(6).to(motion) / expected_px**2
    force = -motion / expected_px**2
    for own in samples:
        centres, shifts = own.places.centres, own.places.shifts
        if len(centres) == 0:
            continue
        seen = _read(own.photo, centres + shifts @ motion).unflatten(1, (-1, 3))
        for rendered, shown in zip(own.rendered.unbind(1), seen.unbind(1), strict=True):
            slopes = (rendered[:, 1:] + shown[:, 1:]) / 2
            difference = rendered[:, 0] - shown[:, 0]
            difference = difference - difference.median()
            deviation = (1.4826 * difference.abs().median()).clamp_min(LEAST_DEVIATION)
            relative = difference / deviation
            weight = own.share / (1 + (relative / OUTLYING) ** 2) ** 2
            jacobian = torch.einsum("ks,ksm->km", slopes, shifts) / deviation
            precision = precision + jacobian.T @ (weight[:, None] * jacobian)
            force = force + jacobian.T @ (weight * relative)
    return torch.linalg.solve(precision, force)


def _read(
    planes: Float64[Tensor, "p h w"], pixels: Float64[Tensor, "k 2"]
) -> Float64[Tensor, "k p"]:
    """Planes at pixel coordinates, between four pixels; beyond the frame as at its edge."""
    height, width = planes.shape[1:]
    places = 2 * pixels / pixels.new_tensor([width, height]) - 1
    read = torch.nn.functional.grid_sample(
        planes[None], places[None, None], padding_mode="border", align_corners=False
    )
    return read[0, :, 0].T


def _half(depth: Float[Tensor, "h w"], which: int) -> Float[Tensor, "h w"]:
    """The depths in every other square of a chessboard; NaN in the others."""
    row, column = (torch.arange(size, device=depth.device) // SQUARE_PX for size in depth.shape)
    taken = (row[:, None] + column) % 2 == which
    return torch.where(taken, depth, torch.nan)
