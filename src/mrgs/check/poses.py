"""Problems of a scene's cameras and points."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.check.problems import Problem
from mrgs.data.oddities import far_off
from mrgs.prepare.page.previews import views_text
from mrgs.rasterizer.near_plane import too_near
from mrgs.scene import Camera, Modality, Scene, View
from mrgs.scene.camera import field_of_view
from mrgs.scene.modality import in_order
from mrgs.scene.rotations import OPENGL_FROM_OPENCV
from mrgs.scene.view import evenly_spaced
from mrgs.system.wording import listed

NO_POINTS = "There are no start points"
"""Beginning of the reader's note if the start points are random."""

FEWEST_VIEWS, FEW_VIEWS = 3, 12
_MOST_POINTS = 1500
_LOST = 0.02
"""A camera that sees a smaller share of the points than this sees none of them to speak of."""

_UNSEEN = 0.25
_CLEARLY_MORE = 4.0
"""Another convention is named where it lets the cameras see that many times more points."""

_LARGEST_EXTENT = 1e6
"""Inverse depths of larger scenes are less than a loss takes for nothing (``distortion_loss``)."""

_SAME_PLACE, _SAME_DIRECTION_DEG = 0.003, 0.3
_APART, _APART_DEG = 0.5, 30.0
_FIELD_OF_VIEW_DEG = (6.0, 130.0)
_CENTRE = (0.25, 0.75)
_ASPECT = 2.0

_FLIP = torch.from_numpy(OPENGL_FROM_OPENCV)
Matrix = Float64[Tensor, "4 4"]

_CONVENTIONS: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "camera axes as in OpenCV (y down, z forward)": (
        lambda viewmat: _FLIP @ viewmat,
        "Negate the second and the third column of each transform_matrix (camera to world, OpenGL "
        "axes).",
    ),
    "world-to-camera matrices with OpenCV axes": (
        lambda viewmat: torch.linalg.inv(viewmat) @ _FLIP,
        "Invert each transform_matrix, then negate the second and the third column of the result.",
    ),
    "world-to-camera matrices with OpenGL axes": (
        lambda viewmat: _FLIP @ torch.linalg.inv(viewmat) @ _FLIP,
        "Invert each transform_matrix: it must be camera to world.",
    ),
}
"""What files hold in place of camera-to-world matrices with OpenGL axes: the view matrix that would
be right, from the one that was read, and what to do."""


def pose_problems(scene: Scene) -> list[Problem]:
    """All problems of views, cameras and points that need no pixels."""
    views = scene.views
    cameras = {view.name: view.camera for view in views}
    found = [*_number_of_views(scene), *_scale(scene, list(cameras.values()))]
    if any(note.startswith(NO_POINTS) for note in scene.notes):
        text = "The scene has no points of its own: the program places some at random."
        found.append(
            Problem(
                "warning",
                text,
                "Add sparse_pc.ply or COLMAP's points; poses cannot be checked without.",
            )
        )
        depth = None
    else:
        points = scene.points.positions[
            evenly_spaced(len(scene.points.positions), _MOST_POINTS)
        ].double()
        found += _seen(cameras, points)
        depth = _median_depth(list(cameras.values()), points)
    found += _same_place(scene, cameras, depth)
    found += _rig(views, depth)
    return found + _intrinsics(scene)


def cameras_by_modality(scene: Scene) -> dict[Modality, dict[str, Camera]]:
    """The cameras of all images of each modality, by the view's name."""
    found: dict[Modality, dict[str, Camera]] = {}
    for view in scene.views:
        for modality, camera in view.cameras.items():
            found.setdefault(modality, {})[view.name] = camera
    return {modality: found[modality] for modality in in_order(found)}


def seen_shares(
    cameras: Sequence[Camera], points: Float64[Tensor, "n 3"]
) -> Float64[Tensor, "v n"]:
    """1 where a camera has a point before it and inside its image, else 0."""
    return torch.stack([camera.contains(camera.project(points)[0]).double() for camera in cameras])


def _number_of_views(scene: Scene) -> list[Problem]:
    count = len(scene.train)
    found = []
    if count < FEWEST_VIEWS:
        text = (
            f"There are {count} training views; at least {FEWEST_VIEWS} are needed to determine "
            f"depth."
        )
        found.append(Problem("error", text, "Add views, or hold fewer out."))
    elif count < FEW_VIEWS:
        text = (
            f"There are only {count} training views: depth will be unreliable where few of them "
            f"overlap."
        )
        found.append(Problem("warning", text, "Take more photos all around; 30 or more are usual."))
    if not scene.eval:
        text = "No view is held out, so the quality of the model cannot be measured."
        remedy = "Name some views in val_filenames, or give no split: then every 8th is taken."
        found.append(Problem("warning", text, remedy))
    return found


def _scale(scene: Scene, cameras: Sequence[Camera]) -> list[Problem]:
    """Lengths that the near plane, or 32-bit floats, do not suit."""
    found = []
    extent = scene.extent
    near = too_near(cameras, scene.points.positions)
    if near is not None:
        found.append(Problem("error", near.text, near.remedy))
    if extent > _LARGEST_EXTENT:
        text = f"The cameras span {2 * extent:.2g} units: the scale is wildly off."
        found.append(
            Problem("error", text, "Scale the poses and the points together, best to metres.")
        )
    offset = far_off(cameras, extent)
    if offset is not None:
        text = (
            f"The scene lies {offset:.2g} units from the origin, but is only {extent:.2g} in size."
        )
        remedy = (
            "Subtract one offset from all positions and points, as from map coordinates: "
            "they would be rounded."
        )
        found.append(Problem("error", text, remedy))
    return found


def _seen(cameras: dict[str, Camera], points: Float64[Tensor, "n 3"]) -> list[Problem]:
    """Poses that do not see the points, and points that no camera sees."""
    seen = seen_shares(list(cameras.values()), points)
    shares = seen.mean(dim=1)
    return (
        _other_convention(list(cameras.values()), points, shares)
        or _other_world(shares)
        or [*_looking_away(list(cameras), shares), *_outside_all_views(seen)]
    )


def _other_convention(
    cameras: Sequence[Camera], points: Float64[Tensor, "n 3"], shares: Float64[Tensor, " v"]
) -> list[Problem]:
    """Poses that would see the points if the file meant something else by its matrices."""
    better, remedy, share = _better_convention(cameras, points, shares.mean().item())
    if not better:
        return []
    text = (
        f"The cameras do not look at the points: they see {shares.mean():.0%} of them, and "
        f"would see {share:.0%} if the file held {better}."
    )
    return [Problem("error", text, remedy)]


def _other_world(shares: Float64[Tensor, " v"]) -> list[Problem]:
    """Poses of which most see next to no points."""
    if not shares.median().item() < _LOST:
        return []
    text = (
        f"The cameras do not look at the points: half of them see less than {_LOST:.0%} of these."
    )
    remedy = "Check that poses and points come from one reconstruction, in one world."
    return [Problem("error", text, remedy)]


def _looking_away(names: Sequence[str], shares: Float64[Tensor, " v"]) -> list[Problem]:
    """Poses that see next to nothing of what is usual."""
    usual = shares.median().item()
    lost = [name for name, own in zip(names, shares.tolist(), strict=True) if own < _LOST * usual]
    if not lost:
        return []
    text = f"The camera of {views_text(lost)} looks away from the points that the others see."
    remedy = "Their poses may be wrong: leave them out, or find them again."
    return [Problem("warning", text, remedy)]


def _outside_all_views(seen: Float64[Tensor, "v n"]) -> list[Problem]:
    """Points that no camera sees, if they are many."""
    unseen = (seen.sum(dim=0) == 0).double().mean().item()
    if not unseen > _UNSEEN:
        return []
    text = f"{unseen:.0%} of the points lie outside all views."
    remedy = (
        "Check that points and poses are in one world, and that the points are not those "
        "of a larger scene."
    )
    return [Problem("warning", text, remedy)]


def _better_convention(
    cameras: Sequence[Camera], points: Float64[Tensor, "n 3"], share: float
) -> tuple[str, str, float]:
    """The convention under which most cameras see clearly more points, what to do, and the share
    (median).

    Empty if there is none. The median, because some cameras look anywhere, also where points of
    another world are.
    """
    best = ("", "", max(_CLEARLY_MORE * share, _LOST))
    for name, (converted, remedy) in _CONVENTIONS.items():
        others = [replace(camera, viewmat=converted(camera.viewmat)) for camera in cameras]
        own = seen_shares(others, points).mean(dim=1).median().item()
        if own > best[2]:
            best = (name, remedy, own)
    return best if best[0] else ("", "", share)


def _median_depth(cameras: Sequence[Camera], points: Float64[Tensor, "n 3"]) -> float | None:
    """How far away the cameras see things; None if they see nothing."""
    depths = torch.cat(
        [depth[depth > 0] for depth in (camera.project(points)[1] for camera in cameras)]
    )
    return depths.median().item() if len(depths) else None


def _same_place(scene: Scene, cameras: dict[str, Camera], depth: float | None) -> list[Problem]:
    """Views that repeat others."""
    names = list(cameras)
    positions = torch.stack([camera.position for camera in cameras.values()])
    forward = torch.stack([camera.forward for camera in cameras.values()])
    right = torch.stack([camera.viewmat[0, :3] for camera in cameras.values()])
    near = torch.cdist(positions, positions) < _SAME_PLACE * (depth or scene.extent)
    limit = math.cos(math.radians(_SAME_DIRECTION_DEG))
    same = (near & (forward @ forward.T > limit) & (right @ right.T > limit)).triu(diagonal=1)
    pairs = [(names[a], names[b]) for a, b in same.nonzero().tolist()]
    if not pairs:
        return []
    held_out = {view.name for view in scene.eval}
    leaking = sum((a in held_out) != (b in held_out) for a, b in pairs)
    named = listed([f"{a} and {b}" for a, b in pairs])
    pairs_text = "1 pair of views has" if len(pairs) == 1 else f"{len(pairs)} pairs of views have"
    text = f"{pairs_text} nearly the same pose ({named})."
    if leaking:
        text += (
            f" In {leaking} of them one is held out and the other trained on: the scores will be "
            f"too good."
        )
    return [Problem("warning", text, "Leave out one of each pair: it adds nothing.")]


def _rig(views: Sequence[View], depth: float | None) -> list[Problem]:
    """Cameras that do not stand beside the first camera of their view."""
    apart: dict[tuple[Modality, Modality], list[str]] = {}
    for view in views:
        (first, camera), *others = view.cameras.items()
        for modality, other in others:
            cosine = max(-1.0, min(1.0, float(camera.forward @ other.forward)))
            distance = (camera.position - other.position).norm().item()
            if math.degrees(math.acos(cosine)) > _APART_DEG or (
                depth is not None and distance > _APART * depth
            ):
                apart.setdefault((first, modality), []).append(view.name)
    return [
        Problem(
            "error",
            f"In {views_text(names)} the {modality.title} camera looks elsewhere than the "
            f"{first.title} camera, or from far beside it.",
            f"Check {modality}_transform_matrix: it needs the convention of transform_matrix.",
        )
        for (first, modality), names in apart.items()
    ]


def _intrinsics(scene: Scene) -> list[Problem]:
    """Fields of view, principal points and pixels that no camera has."""
    found = []
    for modality, cameras in cameras_by_modality(scene).items():
        odd = {
            name: reason for name, camera in cameras.items() if (reason := _odd_intrinsics(camera))
        }
        if odd:
            first = next(iter(odd.values()))
            found.append(
                Problem(
                    "warning",
                    f"The {modality.title} intrinsics of {views_text(list(odd))} are implausible: "
                    f"{first}.",
                    "Compare fl_x, fl_y, cx, cy with the image size that they are for.",
                )
            )
    return found


def _odd_intrinsics(camera: Camera) -> str:
    fx, fy = camera.K[0, 0].item(), camera.K[1, 1].item()
    wide = math.degrees(field_of_view(camera.width, fx))
    x, y = camera.K[0, 2].item() / camera.width, camera.K[1, 2].item() / camera.height
    if not _FIELD_OF_VIEW_DEG[0] <= wide <= _FIELD_OF_VIEW_DEG[1]:
        return f"a field of view of {wide:.1f}°"
    if not (_CENTRE[0] <= x <= _CENTRE[1] and _CENTRE[0] <= y <= _CENTRE[1]):
        return (
            f"an optical axis that meets the image at {x:.0%} of its width and {y:.0%} of its "
            f"height"
        )
    if not 1 / _ASPECT <= fx / fy <= _ASPECT:
        return f"pixels {fx / fy:.2g} times as high as wide"
    return ""
