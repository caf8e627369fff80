"""A scene: its views, its start points, and its temperature scale."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor

from mrgs.scene.camera import Camera
from mrgs.scene.modality import Modality, in_order
from mrgs.scene.reach import Reach, reach
from mrgs.scene.temperature import TemperatureRange
from mrgs.scene.view import View

STILL_CAMERAS = 1e-3
"""Cameras that stay within this share of the distance to what they see count as standing still."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Start points of the Gaussians: positions in world coordinates [N, 3] and RGB in [0, 1] [N,
    3]."""

    positions: Float32[Tensor, "n 3"]
    colors: Float32[Tensor, "n 3"]


@dataclass(frozen=True, eq=False)
class Scene:
    """What training and evaluation need to know about a capture.

    Attributes:
        name: the folder's name.
        train: views to learn from; never empty.
        eval: views held out; may be empty.
        points: start points.
        temperature: scale of the thermal values; None if the capture has no known °C.
        notes: repairs and decisions of the reader, one sentence each, for the user and the report.
    """

    name: str
    train: tuple[View, ...]
    eval: tuple[View, ...]
    points: PointCloud
    temperature: TemperatureRange | None
    notes: tuple[str, ...] = ()

    @property
    def extent(self) -> float:
        """Radius of the training cameras about their mean, times 1.1 (3DGS's scene extent), in
        scene units.

        Cameras that hardly move (a tripod, a single view) tell nothing of the scene's size: then
        the median distance of the start points stands in.
        """
        positions = torch.stack(
            [camera.position for view in self.train for camera in view.cameras.values()]
        )
        centre = positions.mean(dim=0)
        extent = 1.1 * (positions - centre).norm(dim=1).max().item()
        distance = (self.points.positions.double() - centre).norm(dim=1).median().item()
        return extent if extent > STILL_CAMERAS * distance else distance

    @property
    def reach(self) -> Reach:
        """How far it reaches; there must be start points."""
        return reach(self.points.positions, self.train_cameras)

    @property
    def train_cameras(self) -> list[Camera]:
        """One camera of each training view: the RGB camera, where it has one."""
        return [view.camera for view in self.train]

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Those of the training images, RGB first, thermal second, others by name."""
        return in_order(modality for view in self.train for modality in view.images)
