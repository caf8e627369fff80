"""Poses of the training views, refined together with the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor, nn

from mrgs.rasterizer.reference import rotation_matrices
from mrgs.scene import Camera, Modality
from mrgs.scene.rotations import cross_matrix

FEWEST_POINTS = 16
"""Fewest points in a photo; with fewer, made-up points show what a motion does to the image."""

MOST_POINTS = 1000
"""Largest number of points in a photo that are used, of twenty times as many in the scene."""

LEAST_EFFECT = 0.03
"""Motions that shift what a view shows by less than this share of what the most effective one does
count as if they did so much: the photo hardly shows how long they are."""

NO_FREEDOM = 1e-6
"""A motion of the whole scene of which the others leave less than this share depends on them: with
one camera, or cameras in a row, some such motions have no effect of their own."""


class PoseRefinement(nn.Module):
    """A small rigid motion of each training view, learned; all cameras of a view move alike.

    Motions are measured by what they do to the image, so that turning and moving are learned alike:
    1 is a root mean square shift by the focal length. What would move, turn or scale the scene as a
    whole is taken out, so that poses that are not refined, for instance of held-out views, stay
    right as far as the given poses are right on average.

    Nothing is moved before ``begin``: poses that are right would get worse.

    Attributes:
        is_checked: whether it is known whether the poses are wrong; on the host, as ``moves``.
        moves: whether poses are refined by now.
    """

    centres: Float64[Tensor, "v 3"]
    axes: Float64[Tensor, "v 6 6"]
    whole: Float64[Tensor, "v6 7"]
    checked: Bool[Tensor, ""]
    begun: Bool[Tensor, ""]

    def __init__(self, views: int) -> None:
        super().__init__()
        self.register_buffer("centres", torch.zeros(views, 3, dtype=torch.float64))
        self.register_buffer("axes", torch.eye(6, dtype=torch.float64).repeat(views, 1, 1))
        self.register_buffer("whole", torch.zeros(6 * views, 7, dtype=torch.float64))
        self.register_buffer("checked", torch.zeros((), dtype=torch.bool))
        self.register_buffer("begun", torch.zeros((), dtype=torch.bool))
        self.motions = nn.Parameter(torch.zeros(views, 6))
        self.is_checked = self.moves = False

    def note_checked(self) -> None:
        """It is known from here on whether the poses are wrong."""
        self.checked.fill_(True)
        self.is_checked = True

    @torch.no_grad()
    def begin(self, motions: Float64[Tensor, "v 6"]) -> None:
        """Refine the poses from here on, beginning with these motions along ``axes``."""
        self.motions.copy_(motions)
        self.begun.fill_(True)
        self.moves = True

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self.is_checked, self.moves = bool(self.checked), bool(self.begun)

    def set_frame(self, cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> None:
        """Find what motions do to the images, before the training, from the first camera of each
        training view and the scene's points."""
        positions = points[:: -(-len(points) // (20 * MOST_POINTS)) or 1].double()
        centres = torch.stack([camera.position for camera in cameras])
        effects = [effect(camera, _seen(camera, positions)) for camera in cameras]
        axes = motion_axes(torch.stack(effects))
        whole = torch.linalg.solve(axes, _motions_of_the_whole(centres)).flatten(0, 1)
        self.centres.copy_(centres)
        self.axes.copy_(axes)
        self.whole.copy_(_basis(whole))

    def refined(
        self, cameras: Mapping[Modality, Camera], view: Int64[Tensor, "1"]
    ) -> dict[Modality, Camera]:
        """The cameras of a training view at its refined pose, which carries the gradient; ``view``
        is its place among the training views, on the device of the motions."""
        motion = self.motion(view)
        return {modality: camera.moved(motion) for modality, camera in cameras.items()}

    def motion(self, view: Int64[Tensor, "1"]) -> Float64[Tensor, "4 4"]:
        """The motion of the world that the cameras of a training view see, in scene units."""
        own = self.axes.index_select(0, view)[0] @ self._free().index_select(0, view)[0]
        return as_matrix(own, self.centres.index_select(0, view)[0])

    @torch.no_grad()
    def all_motions(self) -> Float64[Tensor, "v 4 4"]:
        """The motions of all training views, in the host's memory."""
        own = (self.axes @ self._free()[:, :, None]).squeeze(2)
        found: Tensor = torch.vmap(as_matrix)(own.cpu(), self.centres.cpu())
        return found

    def without_global_motion(
        self, motions: Float64[Tensor, "k 6"], views: Sequence[int]
    ) -> Float64[Tensor, "k 6"]:
        """Motions of some views along ``axes``, without what moves the scene as a whole."""
        basis = _basis(self.whole.unflatten(0, (-1, 6))[list(views)].flatten(0, 1))
        flat = motions.flatten()
        return (flat - basis @ (basis.T @ flat)).view(-1, 6)

    def shifts(self) -> Float64[Tensor, " v"]:
        """How far the motion of each training view shifts what its first camera sees, as a root
        mean square in focal lengths."""
        return self._free().detach().norm(dim=1)

    def _free(self) -> Float64[Tensor, "v 6"]:
        """The motions without what they do to the scene as a whole."""
        flat = self.motions.double().flatten()
        return (flat - self.whole @ (self.whole.T @ flat)).view(-1, 6)


def _seen(camera: Camera, points: Float64[Tensor, "n 3"]) -> Float64[Tensor, "k 3"]:
    """Points that lie in a camera's image; where these are few, points before the camera."""
    pixels, _ = camera.project(points)
    seen = points[camera.contains(pixels)]
    if len(seen) >= FEWEST_POINTS:
        return seen[:: -(-len(seen) // MOST_POINTS)]
    distance = (points - camera.position).norm(dim=1).median()
    grid = camera.resized(4, 4)
    return grid.unproject_image(distance.expand(4, 4)).flatten(0, 1)


def _basis(columns: Float64[Tensor, "n k"]) -> Float64[Tensor, "n k"]:
    """An orthonormal basis of what the columns span, by Gram–Schmidt, with zeros for dependent
    columns. Unlike LAPACK's, its bits are the same with any number of threads."""
    found = torch.zeros_like(columns)
    for place, column in enumerate(columns.unbind(1)):
        rest = column
        for _ in range(2):  # the second time for what rounding has left
            along = (found * rest[:, None]).sum(dim=0)
            rest = rest - (found * along).sum(dim=1)
        if rest.norm() > NO_FREEDOM * column.norm():
            found[:, place] = rest / rest.norm()
    return found


def _motions_of_the_whole(centres: Float64[Tensor, "v 3"]) -> Float64[Tensor, "v 6 7"]:
    """Motions of all views together that change no image, in columns: of a scene that is moved,
    turned or scaled as a whole."""
    places = centres - centres.mean(dim=0)
    count = len(places)
    each = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    moved = torch.cat([torch.zeros_like(each), each], dim=1)
    turned = torch.cat([each, -cross_matrix(places)], dim=1)
    scaled = torch.cat([torch.zeros_like(places), places], dim=1)[:, :, None]
    return torch.cat([moved, turned, scaled], dim=2)


def shift_per_motion(
    camera: Camera, points: Float64[Tensor, "k 3"], centre: Float64[Tensor, "3"]
) -> Float64[Tensor, "k 2 6"]:
    """J: how points move in the image, in focal lengths, with a small motion of the world: the
    derivatives of (x/z, y/z) by a rotation vector about the centre and a translation."""
    viewmat = camera.viewmat.to(points)
    rotation = viewmat[:3, :3]
    turned = -rotation @ cross_matrix(points - centre)
    moved = torch.cat([turned, rotation.expand(len(points), 3, 3)], dim=2)
    x, y, z = (points @ rotation.T + viewmat[:3, 3]).unbind(-1)
    zero = torch.zeros_like(z)
    project = torch.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], dim=-1)
    return project.unflatten(-1, (2, 3)) @ moved


def motion_axes(effects: Float64[Tensor, "*views 6 6"]) -> Float64[Tensor, "*views 6 6"]:
    """Directions in which views show least to most of a motion, in columns, from their ``effect``:
    a coordinate of 1 shifts what a view shows by a root mean square of a focal length."""
    squares, directions = torch.linalg.eigh(effects)
    least = LEAST_EFFECT**2 * squares[..., -1:]
    return directions / squares.clamp_min(least).sqrt()[..., None, :]


def effect(camera: Camera, points: Float64[Tensor, "k 3"]) -> Float64[Tensor, "6 6"]:
    """M, where mᵀ M m is the mean square of the shifts of points in the image, in focal lengths, by
    a small motion m of the world about the camera's centre: a rotation vector and a translation."""
    shifts = shift_per_motion(camera, points, camera.position).flatten(0, 1)
    return shifts.T @ shifts / len(points)


def as_matrix(motion: Float64[Tensor, "6"], centre: Float64[Tensor, "3"]) -> Float64[Tensor, "4 4"]:
    """The small motion of the world about a centre, a rotation vector and a translation, as the
    matrix that a camera's ``viewmat`` is multiplied with."""
    turn, shift = motion.split(3)
    # About the vector, for small ones; a quaternion has no branch at 0, and never fails.
    rotation = rotation_matrices(torch.cat([turn.new_ones(1), turn / 2])[None])[0]
    moved = torch.cat([rotation, (centre + shift - rotation @ centre)[:, None]], dim=1)
    return torch.cat([moved, torch.eye(4, dtype=moved.dtype, device=moved.device)[3:]])
