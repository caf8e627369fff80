"""A scene: its views, its start points, and its temperature scale."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import torch

from mrgs.errors import SceneError
from mrgs.scene.arrays import Array, as_whole
from mrgs.scene.camera import Camera
from mrgs.scene.from_arrays import (
    Images,
    cameras_from,
    cloud_from_arrays,
    color_images,
    range_of,
    thermal_images,
    views_from_arrays,
    warn_of_kelvin,
)
from mrgs.scene.modality import THERMAL, Modality, in_order
from mrgs.scene.point_cloud import PointCloud, random_points
from mrgs.scene.radiometry import PhotoRecord, TemperatureRange
from mrgs.scene.view import PosedImage, View
from mrgs.scene.world import SceneBounds, WorldFrame

STILL_CAMERAS = 1e-3
"""Cameras that stay within this share of the distance to what they see count as standing still."""


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """What training and evaluation need to know about a capture.

    Attributes:
        name: the folder's name.
        train: views to learn from; never empty.
        eval: views held out; may be empty.
        points: start points.
        temperature: scale of the thermal values; None if the capture has no known °C.
        notes: repairs and decisions of the reader, one sentence each, for the user and the report.
        path: absolute path that it was read from; empty for a scene made from arrays.
        resolution: wider images were reduced to this width when it was read; None if they were not.
        world: what is known of the frame of its coordinates.
    """

    name: str
    train: tuple[View, ...]
    eval: tuple[View, ...]
    points: PointCloud
    temperature: TemperatureRange | None
    notes: tuple[str, ...] = ()
    path: str = field(default="", kw_only=True)
    resolution: int | None = field(default=None, kw_only=True)
    world: WorldFrame = field(default=WorldFrame(), kw_only=True)

    @classmethod
    def from_arrays(
        cls,
        cameras: Iterable[Camera],
        *,
        rgb: Images | None = None,
        celsius: Images | None = None,
        thermal_cameras: Iterable[Camera] | None = None,
        points: Array | None = None,
        colors: Array | None = None,
        eval_every: int = 8,
        seed: int = 0,
        name: str = "scene",
    ) -> Scene:
        """A scene from images in memory, without a folder.

        The images are not copied where they need not be; do not change them while the scene is in
        use. °C are scaled to the range of all views, rounded outwards to whole degrees. NaN and
        masked elements (``np.ma``) are pixels that are not known, and images without a known pixel
        count as none. What is None or empty is not there.

        Args:
            cameras: of the views, one each, in the order of the images; of the RGB images, and of
                the thermal images unless ``thermal_cameras`` are given.
            rgb: of each view, [H, W, 3]: uint8, or numbers in [0, 1]; None for a view without one.
            celsius: temperatures in °C of each view, [H, W]; None as for ``rgb``.
            thermal_cameras: of the thermal images, one for each view; else those of ``cameras``.
            points: start points in world coordinates, [N, 3]; else drawn before the cameras.
            colors: RGB of the points, uint8 or in [0, 1], [N, 3]; else grey.
            eval_every: every Nth view is held out, beginning with the first; 0 holds out none.
            seed: for the start points where none are given.
            name: of the scene, for reports and the default names of files.

        Warns:
            MrgsWarning: the temperatures look like kelvin.

        Raises:
            SceneError: there is no view, a view has no image, or no temperature is finite.
            ValueError: the numbers of cameras and images differ, an image has not the size of its
                camera, an array has another shape or values in another range, or ``eval_every`` is
                not 0 or a whole number from 2.
        """
        eval_every = as_whole(eval_every, "eval_every")
        if eval_every != 0 and eval_every < 2:
            raise ValueError(f"eval_every must be 0, or at least 2, not {eval_every}")
        cameras = cameras_from(cameras, "cameras")
        thermal = thermal_images(celsius)
        warn_of_kelvin(thermal)
        temperature = range_of(thermal)
        views = views_from_arrays(
            cameras,
            color_images(rgb),
            thermal,
            cameras_from(thermal_cameras, "thermal_cameras") or cameras,
            temperature,
        )
        if not views:
            raise SceneError("a scene needs at least one view: give cameras and images")
        held_out = tuple(views[::eval_every]) if eval_every and len(views) > 1 else ()
        train = tuple(view for view in views if view not in held_out)
        cloud = cloud_from_arrays(points, colors)
        if cloud is None:
            cloud = random_points([each for view in train for each in view.cameras.values()], seed)
        return cls(name, train, held_out, cloud, temperature)

    def __repr__(self) -> str:
        modalities = " + ".join(modality.title for modality in self.modalities)
        scale = "no °C" if self.temperature is None else str(self.temperature)
        return (
            f"Scene({self.name!r}, {len(self.train)} training + {len(self.eval)} evaluation views, "
            f"{modalities}, {scale}, {len(self.points):,} points)"
        )

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
    def reach(self) -> SceneBounds:
        """Its bounds; there must be start points."""
        return SceneBounds.of(self.points.positions, self.train_cameras)

    @property
    def views(self) -> tuple[View, ...]:
        """All views: training views first, then held-out ones."""
        return (*self.train, *self.eval)

    @property
    def train_cameras(self) -> list[Camera]:
        """One camera of each training view: the RGB camera, where it has one."""
        return [view.camera for view in self.train]

    def train_photos(self, modality: Modality) -> list[PosedImage]:
        """The training photos of a modality."""
        return [view.images[modality] for view in self.train if modality in view.images]

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities of the training images: RGB first, thermal second, others by name."""
        return in_order(modality for view in self.train for modality in view.images)

    @property
    def records(self) -> list[PhotoRecord]:
        """What the camera noted beside the thermal photos, as far as the scene says."""
        found = (view.images[THERMAL].record for view in self.views if THERMAL in view.images)
        return [record for record in found if record is not None]
