"""Rules for a scene's cameras and points."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.check.problem import (
    NO_POINTS,
    Evidence,
    Problem,
    cameras_by_modality,
    views_text,
    visible,
)
from mrgs.rasterizer.contract import NEAR_PLANE
from mrgs.scene import Camera, Modality, View
from mrgs.scene.camera import field_of_view
from mrgs.scene.rotations import OPENGL_FROM_OPENCV
from mrgs.scene.view import evenly_spaced
from mrgs.system.wording import listed

MIN_VIEWS, FEW_VIEWS = 3, 12

_NEAR_SHARE = 0.01
"""Smallest share of the visible points in front of the near plane that harms a training."""

_NEAR_CAMERAS, _NEAR_POINTS = 200, 2_000
"""Maximum number of cameras and points that are inspected for the near plane."""

_USUAL_DEPTH = 100.0
"""Median depth, in near-plane distances, at which the unit of length is small enough: then only
stray points are in front of the plane."""

_LARGEST_EXTENT = 1e6
"""In scenes of a larger extent, inverse depths vanish in the losses (``distortion_loss``)."""

_FARTHEST = 1e4
"""Distance from the origin, in extents of the scene, beyond which float32 is too coarse."""

_FEW_SEEN = 0.05
"""Smallest share of the points that all training views together see if poses and points agree."""

_FEWEST_SEEN, _MOST_ALONE = 20, 0.1
"""Where the median view sees fewer points, or a larger share of the views overlaps with no other,
the points are too sparse to judge the overlap."""

_LOST = 0.02
"""A camera that sees a smaller share of the points looks away from them."""

_UNSEEN = 0.25
_CLEARLY_MORE = 4.0
"""Another convention is named if the cameras would see this many times more points with it."""

_SAME_PLACE, _SAME_DIRECTION_DEG = 0.003, 0.3
_APART, _APART_DEG = 0.5, 30.0
_FIELD_OF_VIEW_DEG = (6.0, 130.0)
_CENTRE = (0.25, 0.75)
_ASPECT = 2.0

_FLIP = torch.from_numpy(OPENGL_FROM_OPENCV)

_CONVENTIONS: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "camera axes as in OpenCV (y down, z forward)": (
        lambda viewmats: _FLIP @ viewmats,
        "Negate the second and the third column of each transform_matrix (camera to world, OpenGL "
        "axes).",
    ),
    "world-to-camera matrices with OpenCV axes": (
        lambda viewmats: torch.linalg.inv(viewmats) @ _FLIP,
        "Invert each transform_matrix, then negate the second and the third column of the result.",
    ),
    "world-to-camera matrices with OpenGL axes": (
        lambda viewmats: _FLIP @ torch.linalg.inv(viewmats) @ _FLIP,
        "Invert each transform_matrix: it must be camera to world.",
    ),
}
"""Conventions that a file may use instead of camera-to-world matrices with OpenGL axes: the correct
view matrices, from those that were read, and what to do."""


def number_of_views(evidence: Evidence) -> Iterator[Problem]:
    """Too few training views, or none held out."""
    count = len(evidence.scene.train)
    if count < MIN_VIEWS:
        yield Problem(
            "error",
            f"There are {count} training views; depth needs at least {MIN_VIEWS}.",
            "Add views, or hold fewer out.",
        )
    elif count < FEW_VIEWS:
        yield Problem(
            "warning",
            f"There are only {count} training views: depth will be unreliable where few of them "
            f"overlap.",
            "Take more photos all around; 30 or more are usual.",
        )
    if not evidence.scene.eval:
        yield Problem(
            "warning",
            "No view is held out, so the quality of the model cannot be measured.",
            "Name some views in val_filenames, or give no split: then every 8th is taken.",
        )


def near_plane(evidence: Evidence) -> Iterator[Problem]:
    """A unit of length so large that much of the scene is in front of the near plane."""
    near = too_near([*evidence.cameras.values()], evidence.scene.points.positions)
    if near is not None:
        share, factor = near
        yield Problem(
            "error",
            f"{share:.0%} of what the cameras see is nearer than {NEAR_PLANE:g} units, where "
            f"nothing is rendered.",
            f"Scale the poses and the points together, such as by {factor:,}.",
        )


def too_near(cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> tuple[float, int] | None:
    """The share of what the cameras see that is in front of the near plane, and the power of ten to
    scale by; None if it is little."""
    chosen = points[evenly_spaced(len(points), _NEAR_POINTS)].double()
    some = [cameras[place] for place in evenly_spaced(len(cameras), _NEAR_CAMERAS)]
    seen = []
    for camera in some:  # ``Camera.project`` knows no pixels of what is nearest
        x, y, depth = (chosen @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).unbind(dim=1)
        pixels = torch.stack([x, y], dim=1) / depth[:, None] * camera.K.diagonal()[:2]
        seen.append(depth[(depth > 0) & camera.contains(pixels + camera.K[:2, 2])])
    depths = torch.cat(seen)
    if not len(depths):
        return None
    share = (depths < NEAR_PLANE).double().mean().item()
    missing = math.log10(_USUAL_DEPTH * NEAR_PLANE / depths.median().item())
    return (share, 10 ** math.ceil(missing)) if share > _NEAR_SHARE and missing > 0 else None


def extent(evidence: Evidence) -> Iterator[Problem]:
    """A scene of millions of units."""
    if evidence.scene.extent > _LARGEST_EXTENT:
        yield Problem(
            "error",
            f"The cameras span {2 * evidence.scene.extent:.2g} units: the scale is wildly off.",
            "Scale the poses and the points together, best to metres.",
        )


def distance_from_origin(evidence: Evidence) -> Iterator[Problem]:
    """Coordinates so large that single precision rounds them, such as a map's."""
    positions = torch.stack([camera.position for camera in evidence.scene.train_cameras])
    distance, size = positions.median(dim=0).values.norm().item(), evidence.scene.extent
    if distance > _FARTHEST * size:
        yield Problem(
            "error",
            f"The scene is {distance:.2g} units from the origin, but is only {size:.2g} in size.",
            "Subtract one offset from all poses and points: coordinates as on a map are rounded.",
        )


def no_points(evidence: Evidence) -> Iterator[Problem]:
    """Start points that are random."""
    if any(note.startswith(NO_POINTS) for note in evidence.scene.notes):
        yield Problem(
            "warning",
            "The scene has no points of its own: the program places some at random.",
            "Add sparse_pc.ply or COLMAP's points; poses cannot be checked without.",
        )


def equal_poses(evidence: Evidence) -> Iterator[Problem]:
    """Training views with exactly the same pose, unless each shows another modality."""
    train = evidence.scene.train

    def pose(view: View) -> tuple[object, ...]:
        return (*view.images, *view.camera.viewmat.flatten().tolist())

    poses = Counter(map(pose, train))
    if 1 == len(poses) < len(train):
        yield Problem(
            "error",
            f"All {len(train)} training views have the same pose, so depth cannot be determined.",
            "Check the poses.",
        )
    elif len(poses) < len(train):
        repeated = [view.name for view in train if poses[pose(view)] > 1]
        yield Problem(
            "warning",
            f"{len(train) - len(poses)} of {len(train)} training views have exactly the pose of "
            f"another view ({listed(repeated)}).",
            "Check that each photo has its own pose.",
        )


def unseen_points(evidence: Evidence) -> Iterator[Problem]:
    """Poses and points that disagree: all training views together see next to nothing."""
    if not _agree(evidence):
        yield _disagreement(evidence)


def _agree(evidence: Evidence) -> bool:
    """Whether all training views see a usual share of the points, if there are enough to judge."""
    count = len(evidence.scene.train)
    if count < MIN_VIEWS or not len(evidence.points):
        return True
    return evidence.visible[:count].any(dim=0).float().mean().item() >= _FEW_SEEN


def _disagreement(evidence: Evidence) -> Problem:
    """The error of poses that do not see the points, with its likely cause."""
    shares = evidence.visible[: len(evidence.scene.train)].double().mean(dim=1)
    text = f"The cameras do not look at the points: they see {shares.mean():.0%} of them"
    if not evidence.scene.path:
        remedy = "Give world-to-camera matrices, with x right, y down and z forward."
        return Problem("error", f"{text}.", remedy)
    better = _better_convention(evidence, shares.mean().item())
    if better is None:
        remedy = "Check that poses and points come from one reconstruction, in one world."
        return Problem("error", f"{text}.", remedy)
    name, remedy, share = better
    text = f"{text}, and would see {share:.0%} if the file used {name}."
    return Problem("error", text, remedy)


def lonely_views(evidence: Evidence) -> Iterator[Problem]:
    """Views that look away from the points, and training views that share none with another."""
    train = evidence.scene.train
    if not len(evidence.points) or not _agree(evidence):
        return
    shares = evidence.visible.double().mean(dim=1)
    away = shares < _LOST * shares.median()
    lost = [name for name, looks in zip(evidence.cameras, away.tolist(), strict=True) if looks]
    if lost:
        yield Problem(
            "warning",
            f"The camera of {views_text(lost)} looks away from the points that the others see.",
            "Their poses may be wrong: leave them out, or find them again.",
        )
    sees = evidence.visible[: len(train)]
    alone = ~(sees & (sees.sum(dim=0) >= 2)).any(dim=1)
    if (
        len(train) < MIN_VIEWS
        or sees.sum(dim=1).median() < _FEWEST_SEEN
        or alone.float().mean() > _MOST_ALONE
    ):
        return
    names = [train[i].name for i in (alone & ~away[: len(train)]).nonzero().flatten().tolist()]
    if names:
        yield Problem(
            "warning",
            f"{len(names)} of {len(train)} training views do not overlap with any other view "
            f"({listed(names)}).",
            "Check their poses, or leave them out.",
        )


def poses_and_points(evidence: Evidence) -> Iterator[Problem]:
    """Cameras that see too few points although all together see many, and points that none sees."""
    if not len(evidence.points) or not _agree(evidence):
        return
    shares = evidence.visible[: len(evidence.scene.train)].double().mean(dim=1)
    if shares.median() < _LOST or _better_convention(evidence, shares.mean().item()) is not None:
        yield _disagreement(evidence)
        return
    unseen = (~evidence.visible.any(dim=0)).double().mean().item()
    if unseen > _UNSEEN:
        yield Problem(
            "warning",
            f"{unseen:.0%} of the points are outside all views.",
            "Check that points and poses are in one world, and that the points are not those of a "
            "larger scene.",
        )


def _better_convention(evidence: Evidence, share: float) -> tuple[str, str, float] | None:
    """The convention with which most training cameras see clearly more points than ``share``, what
    to do, and the median share with it, as some cameras may look at points of another world by
    chance; None if there is none."""
    cameras = evidence.scene.train_cameras
    viewmats = torch.stack([camera.viewmat for camera in cameras])
    found = []
    for name, (converted, remedy) in _CONVENTIONS.items():
        seen: Bool[Tensor, "v n"] = visible(cameras, converted(viewmats), evidence.points)
        found.append((name, remedy, seen.double().mean(dim=1).median().item()))
    best = max(found, key=lambda one: one[2])
    return best if best[2] > max(_CLEARLY_MORE * share, _LOST) else None


def _median_depth(evidence: Evidence) -> float | None:
    """Median depth of the points in front of the cameras; None if there are none."""
    points = evidence.points[evenly_spaced(len(evidence.points), 1500)].double()
    depths = [camera.project(points)[1] for camera in evidence.cameras.values()]
    ahead = torch.cat([depth[depth > 0] for depth in depths])
    return ahead.median().item() if len(ahead) else None


def similar_poses(evidence: Evidence) -> Iterator[Problem]:
    """Views whose poses are nearly the same, and which do not show different modalities; exactly
    the same only if one is held out."""
    scene, cameras = evidence.scene, [*evidence.cameras.values()]
    shown = {view.name: [*view.images] for view in scene.views}
    names, held_out = [*evidence.cameras], {view.name for view in scene.eval}
    viewmats = torch.stack([camera.viewmat for camera in cameras])
    positions = torch.stack([camera.position for camera in cameras])
    forward, right = viewmats[:, 2, :3], viewmats[:, 0, :3]
    near = torch.cdist(positions, positions) < _SAME_PLACE * (
        _median_depth(evidence) or scene.extent
    )
    limit = math.cos(math.radians(_SAME_DIRECTION_DEG))
    same = (near & (forward @ forward.T > limit) & (right @ right.T > limit)).triu(diagonal=1)
    pairs = [
        (names[a], names[b])
        for a, b in same.nonzero().tolist()
        if shown[names[a]] == shown[names[b]]
        and (b >= len(scene.train) or not torch.equal(viewmats[a], viewmats[b]))
    ]
    if not pairs:
        return
    leaking = sum((a in held_out) != (b in held_out) for a, b in pairs)
    named = listed([f"{a} and {b}" for a, b in pairs])
    count = "1 pair of views has" if len(pairs) == 1 else f"{len(pairs)} pairs of views have"
    text = f"{count} nearly the same pose ({named})."
    if leaking:
        text += (
            f" In {leaking} of them one is held out and the other trained on: the scores will be "
            f"too good."
        )
    yield Problem("warning", text, "Leave out one of each pair: it adds nothing.")


def rig(evidence: Evidence) -> Iterator[Problem]:
    """Cameras that are not beside the first camera of their view."""
    depth = _median_depth(evidence)
    apart: dict[tuple[Modality, Modality], list[str]] = {}
    for view in evidence.scene.views:
        (first, camera), *others = view.cameras.items()
        for modality, other in others:
            cosine = max(-1.0, min(1.0, float(camera.forward @ other.forward)))
            distance = (camera.position - other.position).norm().item()
            if math.degrees(math.acos(cosine)) > _APART_DEG or (
                depth is not None and distance > _APART * depth
            ):
                apart.setdefault((first, modality), []).append(view.name)
    for (first, modality), names in apart.items():
        yield Problem(
            "error",
            f"In {views_text(names)} the {modality.title} camera looks elsewhere than the "
            f"{first.title} camera, or is far from it.",
            f"Check {modality}_transform_matrix: it needs the convention of transform_matrix.",
        )


def intrinsics(evidence: Evidence) -> Iterator[Problem]:
    """Fields of view, principal points and pixel shapes that no camera has."""
    for modality, cameras in cameras_by_modality(evidence.scene).items():
        reasons = {name: _implausible(camera) for name, camera in cameras.items()}
        odd = {name: reason for name, reason in reasons.items() if reason}
        if odd:
            yield Problem(
                "warning",
                f"The {modality.title} intrinsics of {views_text(list(odd))} are implausible: "
                f"{next(iter(odd.values()))}.",
                "Compare fl_x, fl_y, cx, cy with the image size that they are for.",
            )


def _implausible(camera: Camera) -> str:
    """What is implausible about a camera's intrinsics; empty if nothing is."""
    fx, fy = camera.K[0, 0].item(), camera.K[1, 1].item()
    wide = math.degrees(field_of_view(camera.width, fx))
    x, y = camera.K[0, 2].item() / camera.width, camera.K[1, 2].item() / camera.height
    if not _FIELD_OF_VIEW_DEG[0] <= wide <= _FIELD_OF_VIEW_DEG[1]:
        return f"a field of view of {wide:.1f}°"
    if not (_CENTRE[0] <= x <= _CENTRE[1] and _CENTRE[0] <= y <= _CENTRE[1]):
        return f"a principal point at {x:.0%} of the width and {y:.0%} of the height of the image"
    if not 1 / _ASPECT <= fx / fy <= _ASPECT:
        return f"pixels {fx / fy:.2g} times as high as wide"
    return ""
