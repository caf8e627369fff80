"""Calibration of a rig's thermal camera from the photos."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from mrgs.errors import SceneError
from mrgs.prepare.contract import Progress
from mrgs.prepare.rig.adjust import (
    LENS,
    MOTION,
    POSE,
    RIG,
    Adjusted,
    Observations,
    Prior,
    ThermalCameras,
    adjust,
    aimed,
    lens_parameters,
    motion_parameters,
    pixel_sigma,
    project,
)
from mrgs.prepare.rig.contract import (
    FEWEST_MATCHES,
    RigCalibration,
    RigOptions,
    RigPair,
    RigView,
    TargetFit,
)
from mrgs.prepare.rig.images import FEWEST_POINTS, ReducedPair, reduced_pair
from mrgs.prepare.rig.refine import refine
from mrgs.prepare.rig.search import Guess, first_guess
from mrgs.prepare.rig.target import LocatedTarget, find_target
from mrgs.scene import PointCloud
from mrgs.scene.camera import field_of_view, focal_length
from mrgs.scene.rotations import matrix_from_rotvec, rotvec_from_matrix
from mrgs.scene.view import evenly_spaced

FEWEST_PAIRS = 3
_SEARCH_PAIRS = 12

_MOVING = 1.0
"""A larger median motion of the pairs, in pixels, gives a warning."""

# Standard deviations of the prior.
_FOCAL_SIGMA, _KNOWN_FOCAL_SIGMA = 0.1, 0.02
"""Standard deviations of the logarithm of the focal length; the second where the files or the user
state the field of view."""

_ASPECT_SIGMA = 0.005
_CENTRE_SIGMA_WIDTHS = 0.03
_RADIAL_SIGMA = 0.3
_TURN_SIGMA_RAD = 0.3
_BASELINE_SIGMA_DEPTHS = (0.05, 0.05, 0.01)
"""Lenses sit side by side behind one front: the offset along the optical axis is the smallest."""

_MOTION_SIGMA_RAD = np.radians(0.5)
_MOTION_SIGMA_DEPTHS = 0.01


def calibrate_rig(
    pairs: Sequence[RigPair],
    points: PointCloud,
    options: RigOptions | None = None,
    progress: Progress | None = None,
) -> RigCalibration:
    """Calibrate the thermal camera's intrinsics, radial distortion and extrinsics.

    A first guess of focal length and direction comes from correlating edges over all scales and
    shifts (``search``), or from the corners of a target, which remain observations to the end
    (``target``). Then, from coarse to fine (``refine``), each photo is warped through its depth
    into the thermal camera, patches of it are matched in the thermal image, and a bundle adjustment
    over all pairs updates the cameras (``adjust``). Every pair has a small motion of its own
    besides the rig's, because two shutters rarely fire together. SceneError for too few pairs or
    points, thermal images of different sizes, images that do not determine the camera, or a target
    that is not found or cannot be located.

    Args:
        pairs: photos with poses, and their thermal images; all thermal images of one size.
        points: triangulated by structure from motion, in the world of the poses.
        options: known quantities; None if nothing is known.
    """
    options = options or RigOptions()
    report = progress or (lambda stage, done, total: None)
    target = corners = fit = None
    if options.target is not None:
        target = find_target(pairs, options.target, options.metres_per_unit, report)
    reduced, size = _reduced(pairs, points, target, report)
    guess, known_deg = _guess(reduced, size, target, options, report)
    start, prior = _start(reduced, size, guess, known_deg, options)
    if target is not None:
        corners = target.observations([pair.name for pair in reduced])
        start = adjust(corners, prior, aimed(start, corners)).cameras
    adjusted, observations = refine(reduced, size, start, prior, report, corners)
    if target is not None and options.target is not None:
        fit = target.fit(adjusted, observations, options.target.square_m)
    return _result(pairs, reduced, size, adjusted, observations, options, fit)


def _reduced(
    pairs: Sequence[RigPair], points: PointCloud, target: LocatedTarget | None, report: Progress
) -> tuple[list[ReducedPair], tuple[int, int]]:
    """The usable pairs at working size, and the thermal images' width and height."""
    positions = points.positions.double().numpy()
    reduced: list[ReducedPair] = []
    sizes: dict[tuple[int, int], str] = {}
    for done, pair in enumerate(pairs):
        report("reading pairs", done, len(pairs))
        own = np.zeros((0, 3)) if target is None else target.world_points(pair.name)
        usable, size = reduced_pair(pair, positions, own)
        sizes.setdefault(size, pair.name)
        if usable is not None:
            reduced.append(usable)
    if len(sizes) > 1:
        (a, b), (first, second) = list(sizes)[:2], list(sizes.values())[:2]
        raise SceneError(
            f"the thermal images are of several sizes ({first} has {a[0]}×{a[1]} px, {second} "
            f"{b[0]}×{b[1]}): prepare each camera separately"
        )
    if len(reduced) < FEWEST_PAIRS:
        raise SceneError(
            f"the thermal camera cannot be placed: only {len(reduced)} photos see {FEWEST_POINTS} "
            f"or more sparse points; take more overlapping photos, or say that one camera took "
            f"both images",
            options=("one_camera",),
        )
    return reduced, next(iter(sizes))


def _guess(
    pairs: Sequence[ReducedPair],
    size: tuple[int, int],
    target: LocatedTarget | None,
    options: RigOptions,
    report: Progress,
) -> tuple[Guess | None, float | None]:
    """The first guess: of the target, else of the images' edges; None if the rig is given. And the
    field of view that was stated and found, degrees."""
    if options.thermal_lens is not None and options.extrinsics is not None:
        return None, None
    if target is not None:
        return target.guess(*size), None
    views_deg = [options.field_of_view_deg]
    if options.thermal_lens is not None:
        views_deg = [math.degrees(field_of_view(size[0], options.thermal_lens.fx))]
    elif options.field_of_view_deg is None and options.stated_field_of_view_deg is not None:
        views_deg = [options.stated_field_of_view_deg, None]
    chosen = [pairs[index] for index in evenly_spaced(len(pairs), _SEARCH_PAIRS)]
    for view_deg in views_deg:
        found = first_guess(chosen, view_deg, report)
        if found.stands_out:
            break
    if not found.stands_out:
        raise SceneError(
            "the thermal camera cannot be placed: the edges in the thermal images agree with "
            "those in the photos no better than by chance (correlation "
            f"{found.best.score:.2f}, by chance {found.chance:.2f}), upright or by quarter turns. "
            "Check that the pairs belong together, and give the thermal camera's field of view, "
            "its lens and offset, or a target in sight; if both images show the same, say that "
            "there is one camera",
            options=("thermal_fov_deg", "thermal_camera", "target", "one_camera"),
        )
    return found.best, view_deg


def _start(
    pairs: Sequence[ReducedPair],
    size: tuple[int, int],
    guess: Guess | None,
    known_deg: float | None,
    options: RigOptions,
) -> tuple[ThermalCameras, Prior]:
    """The initial cameras and the prior. The guess's shift becomes a rotation of the thermal
    camera; the prior's field of view is the known one."""
    width, height = size
    depth = float(np.median([1 / pair.depth.median for pair in pairs]))
    rig = torch.zeros(RIG, dtype=torch.float64)
    rig[2], rig[3] = width / 2, height / 2
    sigma = torch.tensor(
        [_FOCAL_SIGMA, _ASPECT_SIGMA, *(2 * [_CENTRE_SIGMA_WIDTHS * width]), _RADIAL_SIGMA,
        _RADIAL_SIGMA]
        + 3 * [_TURN_SIGMA_RAD] + [share * depth for share in _BASELINE_SIGMA_DEPTHS],
        dtype=torch.float64,
    )  # fmt: skip
    if guess is not None:
        right, down = guess.shift_widths
        rig[0] = np.log(guess.focal_widths * width)
        aim = matrix_from_rotvec([-down / guess.focal_widths, right / guess.focal_widths, 0.0])
        turn = matrix_from_rotvec([0.0, 0.0, -np.radians(guess.turn_deg)])
        rig[6:9] = torch.from_numpy(rotvec_from_matrix(aim @ turn))
    if options.thermal_lens is not None:
        rig[LENS], sigma[LENS] = lens_parameters(options.thermal_lens), 0.0
    if options.extrinsics is not None:
        rig[POSE], sigma[POSE] = motion_parameters(options.extrinsics), 0.0
    motion_sigma = torch.tensor(
        3 * [_MOTION_SIGMA_RAD] + 3 * [_MOTION_SIGMA_DEPTHS * depth], dtype=torch.float64
    )
    mean = rig.clone()
    if known_deg is not None and options.thermal_lens is None:
        mean[0] = math.log(focal_length(width, math.radians(known_deg)))
        sigma[0] = _KNOWN_FOCAL_SIGMA
    motions = torch.zeros(len(pairs), MOTION, dtype=torch.float64)
    return ThermalCameras(rig, motions), Prior(mean, sigma, motion_sigma)


def _result(
    pairs: Sequence[RigPair],
    reduced: Sequence[ReducedPair],
    size: tuple[int, int],
    adjusted: Adjusted,
    observations: Observations,
    options: RigOptions,
    target: TargetFit | None,
) -> RigCalibration:
    """The calibration; pairs whose photo sees too few points get the rig's motion alone."""
    counts = torch.bincount(observations.views, minlength=len(reduced))
    rows = observations.views.argsort(stable=True).split(counts.tolist())
    calibrated = {
        pair.name: _view(pair.name, view, rows[view], adjusted, observations)
        for view, pair in enumerate(reduced)
    }
    uncertainty_px = float(np.median([view.uncertainty_px for view in calibrated.values()]))
    if not uncertainty_px <= options.max_uncertainty_px:
        raise SceneError(
            f"the thermal camera cannot be placed: the photos leave {uncertainty_px:.1f} px open "
            f"(one standard deviation), and {options.max_uncertainty_px:g} px is the limit; give "
            f"its field of view, its lens or offset, or more pairs",
            options=("thermal_fov_deg", "thermal_camera"),
        )
    alone = RigView("", torch.eye(4, dtype=torch.float64), 0, float("nan"), float("inf"))
    residuals = adjusted.residual_px[adjusted.inlier].numpy()
    motion_px = float(np.median(_motion_px(adjusted.cameras, observations, rows)))
    return RigCalibration(
        lens=adjusted.cameras.lens(*size),
        extrinsics=adjusted.cameras.extrinsics(),
        views=tuple(calibrated.get(each.name, replace(alone, name=each.name)) for each in pairs),
        residual_px=(float(np.median(residuals)), float(np.quantile(residuals, 0.9))),
        uncertainty_px=uncertainty_px,
        motion_px=motion_px,
        warnings=tuple(_warnings(pairs, calibrated, motion_px, options)),
        target=target,
    )


def _view(
    name: str, view: int, own: Int64[Tensor, " k"], adjusted: Adjusted, observations: Observations
) -> RigView:
    """The result of a pair, from its ``own`` rows of the observations."""
    agreeing = own[adjusted.inlier[own]]
    residual_px = float(adjusted.residual_px[agreeing].median()) if len(agreeing) else math.nan
    where = own if len(agreeing) >= FEWEST_MATCHES else slice(None)
    uncertainty_px = float(pixel_sigma(adjusted, view, observations.points[where]).median())
    correction = adjusted.cameras.correction(view)
    return RigView(name, correction, len(agreeing), residual_px, uncertainty_px)


def _motion_px(
    cameras: ThermalCameras, observations: Observations, rows: Sequence[Int64[Tensor, "_"]]
) -> list[float]:
    """Displacement of each pair's patches by its own motion, median, in thermal pixels."""
    motions = cameras.motions[observations.views]
    moved, still = (
        project(cameras.rig, each, observations.points)
        for each in (motions, torch.zeros_like(motions))
    )
    distance = (moved - still).norm(dim=1)
    return [float(distance[own].median()) for own in rows if len(own)]


def _warnings(
    pairs: Sequence[RigPair],
    calibrated: Mapping[str, RigView],
    motion_px: float,
    options: RigOptions,
) -> list[str]:
    found = []
    unseen = [pair.name for pair in pairs if pair.name not in calibrated]
    if unseen:
        found.append(
            f"{len(unseen)} photos see too few points to correct their thermal camera: "
            f"{', '.join(unseen)}."
        )
    doubtful = [
        view.name
        for view in calibrated.values()
        if view.uncertainty_px > options.max_uncertainty_px
    ]
    if doubtful:
        found.append(
            f"{len(doubtful)} thermal images could not be placed well ({', '.join(doubtful)}): "
            f"few edges agree with their photos, and the pairs do not move alike. Leave these "
            f"pairs out if they look wrong."
        )
    if motion_px > _MOVING:
        found.append(
            f"The thermal camera moved relative to the RGB camera by {motion_px:.1f} px (median) "
            "from pair to pair, as if the two did not fire together; each pair got a correction of "
            "its own. Hold still while photographing."
        )
    return found
