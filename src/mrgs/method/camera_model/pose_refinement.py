"""Poses of the training views, refined together with the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor, nn

from mrgs.method.camera_model.view_motion import as_matrix, effect, motion_axes
from mrgs.scene import Camera, Modality
from mrgs.scene.rotations import cross_matrix

FEWEST_POINTS = 16
"""Fewest points in a photo; with fewer, points made up before the camera show what a motion does to
the image."""

MOST_POINTS = 1000
"""Of those that lie in a photo; of the scene, twenty times as many are looked through."""

NO_FREEDOM = 1e-6
"""A motion of which the others leave less than this share is none of its own: with one camera, or
cameras in a row, some motions of the scene as a whole are no motions of these."""


class PoseRefinement(nn.Module):
    """A small rigid motion of each training view, learned; all cameras of a view move alike.

    Motions are measured by what they do to the image, so that turning and moving are learned alike:
    1 is a root mean square shift by the focal length. What would move, turn or scale the scene as a
    whole is taken out, so that poses that are not refined, those of held-out views for instance,
    stay right as far as the given poses are right on average.

    Nothing is moved before ``begin``: poses that are right would get worse.

    Args:
        views: number of training views.
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
        self._is_checked = self._moves = False

    @property
    def is_checked(self) -> bool:
        """Whether it is known whether the poses are wrong; a GPU is not asked."""
        return self._is_checked

    @property
    def moves(self) -> bool:
        """Whether poses are refined by now; a GPU is not asked."""
        return self._moves

    def note_checked(self) -> None:
        """It is known from here on whether the poses are wrong."""
        self.checked.fill_(True)
        self._is_checked = True

    @torch.no_grad()
    def begin(self, motions: Float64[Tensor, "v 6"]) -> None:
        """Refine the poses from here on.

        Args:
            motions: of the views, to begin with, along ``axes``.
        """
        self.motions.copy_(motions)
        self.begun.fill_(True)
        self._moves = True

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._is_checked, self._moves = bool(self.checked), bool(self.begun)

    def set_frame(self, cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> None:
        """Find what motions do to the images; before the training.

        Args:
            cameras: the first one of each training view.
            points: of the scene, in scene units.
        """
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
        """The cameras of a training view at its refined pose, which carries the gradient.

        Args:
            cameras: of the view.
            view: its place among the training views, on the device of the motions.
        """
        motion = self.motion(view)
        return {modality: camera.moved(motion) for modality, camera in cameras.items()}

    def motion(self, view: Int64[Tensor, "1"]) -> Float64[Tensor, "4 4"]:
        """The motion of the world that the cameras of a training view see, in scene units."""
        own = self.axes.index_select(0, view)[0] @ self._free().index_select(0, view)[0]
        return as_matrix(own, self.centres.index_select(0, view)[0])

    def apart_from_the_whole(
        self, motions: Float64[Tensor, "k 6"], views: Sequence[int]
    ) -> Float64[Tensor, "k 6"]:
        """Motions of some views, without what is a motion of the scene as a whole.

        Args:
            motions: along ``axes``.
            views: whose they are.
        """
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
    """Unit vectors that are normal to each other and span what the columns span, by Gram–Schmidt;
    zeros in the place of those that are missing. Unlike LAPACK's, its bits are the same with any
    number of threads."""
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
    """Motions of all views together that change no image, in columns: those of a scene that is
    moved, turned or scaled as a whole."""
    places = centres - centres.mean(dim=0)
    count = len(places)
    each = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    moved = torch.cat([torch.zeros_like(each), each], dim=1)
    turned = torch.cat([each, -cross_matrix(places)], dim=1)
    scaled = torch.cat([torch.zeros_like(places), places], dim=1)[:, :, None]
    return torch.cat([moved, turned, scaled], dim=2)
