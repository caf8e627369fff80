"""A scene: its views, its start points, and its temperature scale."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import zip_longest
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from mrgs.errors import SceneError, warn_user
from mrgs.scene.arrays import Array, as_floats, as_tensor, as_whole
from mrgs.scene.camera import Camera
from mrgs.scene.depth_map import surveying, visible
from mrgs.scene.lens import Lens, matrix_of, pinhole_of, undistort
from mrgs.scene.modality import RGB, THERMAL, Modality, in_order
from mrgs.scene.point_cloud import GREY, PointCloud, random_points
from mrgs.scene.radiometry import (
    COLDEST_C,
    HOTTEST_C,
    ZERO_CELSIUS_K,
    PhotoRecord,
    TemperatureRange,
    are_everyday,
)
from mrgs.scene.view import Pixels, PosedImage, View, evenly_spaced
from mrgs.scene.world import SceneBounds, WorldFrame

STILL_CAMERAS = 1e-3
"""Cameras that stay within this share of the distance to what they see count as standing still."""

TIMES_DEPTH, MOST_CAMERAS, MOST_POINTS = 1.25, 32, 20_000
"""Limit of a scene's extent; and cameras and points, evenly spaced, from which it is found."""


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """What training and evaluation need to know about a capture.

    Attributes:
        name: the folder's name.
        train: views to learn from; never empty.
        eval: views held out; may be empty.
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
        distortion: Distortion | None = None,
        thermal_distortion: Distortion | None = None,
        fisheye: bool = False,
        thermal_fisheye: bool = False,
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
        count as missing, as do None and empty arguments.

        Args:
            cameras: of the views, one each, in the order of the images; of the RGB images, and of
                the thermal images unless ``thermal_cameras`` are given.
            rgb: of each view, [H, W, 3]: uint8, or numbers in [0, 1]; None for a view without one.
            celsius: temperatures in °C of each view, [H, W]; None as for ``rgb``.
            thermal_cameras: of the thermal images, one for each view; else those of ``cameras``.
            distortion: OpenCV's coefficients of the lens of ``cameras``, if the images are not
                undistorted: k1, k2, p1, p2[, k3], or k1, k2, k3, k4 of a fisheye; one set for all
                views, also as one array of shape [n, 1], or one for each, None for a view without
                distortion. Images are undistorted when they are read, and the cameras of the views
                become those of what is left.
            thermal_distortion: the same of ``thermal_cameras``.
            fisheye: whether ``distortion`` is that of ``cv2.fisheye``.
            thermal_fisheye: whether ``thermal_distortion`` is.
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
                camera, an array has another shape or values in another range, a lens has another
                number of coefficients or such as fold the image, a fisheye has none, or
                ``eval_every`` is not 0 or a whole number from 2.
        """
        eval_every = as_whole(eval_every, "eval_every")
        if eval_every != 0 and eval_every < 2:
            raise ValueError(f"eval_every must be 0, or at least 2, not {eval_every}")
        cameras = _cameras_from(cameras, "cameras")
        thermal = _thermal_images(celsius)
        temperature = _range_of(thermal)
        own = _cameras_from(thermal_cameras, "thermal_cameras")
        if (thermal_distortion is not None or thermal_fisheye) and not own:
            name = "thermal_fisheye" if thermal_distortion is None else "thermal_distortion"
            raise ValueError(f"{name} is that of thermal_cameras: give these, too")
        posed = _with_lenses(cameras, distortion, fisheye, "distortion")
        given = thermal_distortion, thermal_fisheye, "thermal_distortion"
        thermal_posed = _with_lenses(own, *given) if own else posed
        views = _views_from_arrays(posed, _color_images(rgb), thermal, thermal_posed, temperature)
        if not views:
            raise SceneError("a scene needs at least one view: give cameras and images")
        held_out = tuple(views[::eval_every]) if eval_every and len(views) > 1 else ()
        train = tuple(view for view in views if view not in held_out)
        cloud = _cloud_from_arrays(points, colors)
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

    @cached_property
    def extent(self) -> float:
        """Radius of the training cameras about their mean, times 1.1 (3DGS's scene extent), in
        scene units; at most ``TIMES_DEPTH`` the median depth of the start points that they see, as
        over a solar plant or along a street; the median distance of the start points where the
        cameras hardly move."""
        positions = torch.stack(
            [camera.position for view in self.train for camera in view.cameras.values()]
        )
        centre, points = positions.mean(dim=0), self.points.positions
        extent = 1.1 * (positions - centre).norm(dim=1).max().item()
        distance = (points.double() - centre).norm(dim=1).median().item()
        if extent <= STILL_CAMERAS * distance:
            return distance
        some = points[:: -(-len(points) // MOST_POINTS) or 1].numpy()
        chosen = evenly_spaced(len(self.train), MOST_CAMERAS)
        seen = [visible(self.train[index].camera, some).z for index in chosen]
        depths = [float(np.median(z)) for z in seen if len(z)]
        return min(extent, TIMES_DEPTH * float(np.median(depths))) if depths else extent

    @property
    def reach(self) -> SceneBounds:
        """The scene's bounds; there must be start points."""
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

    def survey_views(self, modality: Modality | None = None) -> tuple[View, ...]:
        """As many training views, with a photo of the modality if one is given, as are needed to
        measure what all of them show: all where they are at most 64, see ``surveying``."""
        if modality not in self._surveys:
            views = [view for view in self.train if modality is None or modality in view.images]
            cameras = [view.images[modality].camera if modality else view.camera for view in views]
            chosen = surveying(cameras, self.points.positions.numpy())
            self._surveys[modality] = tuple(views[index] for index in chosen)
        return self._surveys[modality]

    def survey_cameras(self, modality: Modality) -> list[Camera]:
        """The cameras that took the photos of a modality in the ``survey_views``."""
        return [view.images[modality].camera for view in self.survey_views(modality)]

    @cached_property
    def _surveys(self) -> dict[Modality | None, tuple[View, ...]]:
        """The ``survey_views`` that were asked for: a second to find among 1,000 photos."""
        return {}

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities of the training images: RGB first, thermal second, others by name."""
        return in_order(modality for view in self.train for modality in view.images)

    @property
    def records(self) -> list[PhotoRecord]:
        """What the camera noted beside the thermal photos, as far as the scene says."""
        found = (view.images[THERMAL].record for view in self.views if THERMAL in view.images)
        return [record for record in found if record is not None]


Images: TypeAlias = Iterable[Array | None]
"""One image for each view, None where a view has none."""

Distortion: TypeAlias = Array | Iterable[Array | None]
"""Coefficients of one lens, or of a lens for each view."""

Posed: TypeAlias = tuple[Camera, Lens | None]
"""A camera with its lens; None if that does not distort."""

_ROUNDING = 1e-3
"""Colours this far outside [0, 1] count as rounded."""

_SAMPLED = 1_000
"""Number of temperatures per image, roughly, that are checked for being in kelvin."""


def _cameras_from(cameras: Iterable[Camera] | None, name: str) -> list[Camera]:
    listed = _listed(cameras, name, "cameras")
    for number, each in enumerate(listed):
        if not isinstance(each, Camera):
            raise ValueError(
                f"{name}[{number}] is of type {type(each).__name__}, not Camera: make it with "
                f"Camera(K, world_to_camera, width, height)"
            )
    return listed


def _with_lenses(
    cameras: Sequence[Camera], distortion: Distortion | None, fisheye: bool, name: str
) -> list[Posed]:
    if fisheye and distortion is None:
        raise ValueError(f"a fisheye has coefficients: give {name}, too")
    given = _listed([None] if distortion is None else distortion, name, "coefficients")
    arrays = [None if each is None else as_floats(each, name) for each in given]
    sets = [None if each is None else each.flatten().tolist() for each in arrays]
    # Rows of a list are lenses, one for each view, even where each has one number.
    is_column = isinstance(distortion, Tensor | np.ndarray) and distortion.shape[1:] == (1,)
    if is_column or all(each is not None and each.ndim == 0 for each in arrays):  # of one lens
        sets = [[number for numbers in sets if numbers for number in numbers]]
    sets = sets * len(cameras) if len(sets) == 1 else sets
    if len(sets) != len(cameras):
        raise ValueError(f"{len(cameras)} cameras, but {len(sets)} lenses in {name}")
    return [
        (camera, None if numbers is None else Lens.of_opencv(camera, numbers, fisheye, name))
        for camera, numbers in zip(cameras, sets, strict=True)
    ]


def _color_images(rgb: Images | None) -> list[Tensor | None]:
    """RGB images of a caller: uint8, or numbers in [0, 1] with NaN in pixels that are not known;
    None for those without a known pixel."""
    images = []
    for number, each in enumerate(_listed(rgb, "rgb", "images")):
        image = None if each is None else _colors(each, (None, None, 3), f"rgb[{number}]")
        images.append(image if image is not None and image.isfinite().any() else None)
    return images


def _thermal_images(celsius: Images | None) -> list[Tensor | None]:
    """Thermal images of a caller in °C, NaN where a pixel is not known; None for those without a
    known pixel. Warns if they look like kelvin: only the caller can know that they show a furnace.
    """
    images: list[Tensor | None] = []
    sampled = []
    for number, each in enumerate(given := _listed(celsius, "celsius", "images")):
        image = None if each is None else as_tensor(each, None, (None, None), f"celsius[{number}]")
        known = None if image is None else image[image.isfinite()]
        if known is None or not len(known):
            images.append(None)
            continue
        low, high = known.min().item(), known.max().item()
        if low < COLDEST_C or high > HOTTEST_C:
            raise ValueError(
                f"celsius[{number}] has values from {low:.5g} to {high:.5g}: give °C between "
                f"{COLDEST_C:g} and {HOTTEST_C:g}, no raw counts, and NaN where not known"
            )
        images.append(image)
        sampled.append(known[:: 1 + len(known) // _SAMPLED].double())
    if any(each is not None for each in given) and not sampled:
        raise SceneError("no thermal image has a finite temperature: give °C")
    if sampled:
        low, middle, high = np.percentile(torch.cat(sampled).numpy(), (1, 50, 99)).tolist()
        if are_everyday(*(value - ZERO_CELSIUS_K for value in (low, middle, high))):
            warn_user(
                f"celsius has values from {low:.5g} to {high:.5g}, which look like kelvin: "
                f"subtract {ZERO_CELSIUS_K} if they are"
            )
    return images


def _range_of(thermal: Sequence[Tensor | None]) -> TemperatureRange | None:
    """The range of thermal images in °C, rounded outwards to whole degrees; None without any."""
    limits = [image[image.isfinite()].aminmax() for image in thermal if image is not None]
    if not limits:
        return None
    return TemperatureRange.around(
        min(low.item() for low, _ in limits), max(high.item() for _, high in limits)
    )


def _views_from_arrays(
    cameras: Sequence[Posed],
    rgb: Sequence[Tensor | None],
    thermal: Sequence[Tensor | None],
    thermal_cameras: Sequence[Posed],
    temperature: TemperatureRange | None,
) -> list[View]:
    """Views of images in memory, named by their number; see ``Scene.from_arrays``."""
    if len(thermal_cameras) != len(cameras):
        raise ValueError(f"{len(cameras)} cameras, but {len(thermal_cameras)} thermal cameras")
    for name, images in (("rgb", rgb), ("celsius", thermal)):
        if len(images) not in (0, len(cameras)):
            raise ValueError(f"{len(cameras)} cameras, but {len(images)} images in {name}")
    views = []
    for number, (camera, colors, thermal_camera, celsius) in enumerate(
        zip_longest(cameras, rgb, thermal_cameras, thermal)
    ):
        found: dict[Modality, PosedImage] = {}
        if colors is not None:
            found[RGB] = _posed(colors, camera, None, f"rgb[{number}]")
        if celsius is not None and temperature is not None:
            found[THERMAL] = _posed(celsius, thermal_camera, temperature, f"celsius[{number}]")
        if not found:
            raise SceneError(f"view {number} has no image with a known pixel: leave its camera out")
        views.append(View(f"{number:05d}", found))
    return views


def _cloud_from_arrays(points: Array | None, colors: Array | None) -> PointCloud | None:
    """The start points that are finite; None without any."""
    if points is None:
        return None
    positions = as_tensor(points, torch.float32, (None, 3), "points")
    given = None if colors is None else _colors(colors, (None, 3), "colors")
    if given is None or not len(given):
        rgb = torch.full_like(positions, GREY)
    elif len(given) == len(positions):
        rgb = _as_shares(given).nan_to_num(GREY, GREY, GREY)
    else:
        raise ValueError(f"{len(positions)} points, but {len(given)} colors")
    finite = positions.square().isfinite().all(dim=1)  # distances are taken in float32
    return PointCloud(positions[finite], rgb[finite]) if finite.any() else None


def _listed(items: Iterable | None, name: str, what: str) -> list:
    """Items of a list, an array, a tensor or a generator; none for None."""
    try:
        return [] if items is None else list(items)
    except TypeError:
        raise ValueError(f"{name} must be a list of {what}, one for each view") from None


def _colors(array: Array, shape: tuple[int | None, ...], name: str) -> Tensor:
    """RGB as uint8, or as numbers in [0, 1] with NaN where it is not known."""
    if isinstance(array, np.ma.MaskedArray) and array.dtype == np.uint8:
        array = array.astype(np.float32) * np.float32(1 / 255)  # bytes have no NaN for the mask
    colors = as_tensor(array, None, shape, name)
    known = colors[:0] if colors.dtype == torch.uint8 else colors[colors.isfinite()]
    if known.numel():
        low, high = known.min().item(), known.max().item()
        if low < -_ROUNDING or high > 1 + _ROUNDING:
            raise ValueError(
                f"{name} has values from {low:.5g} to {high:.5g}: give uint8, or numbers in [0, 1]"
            )
    return colors


def _as_shares(colors: Tensor) -> Float32[Tensor, "*n 3"]:
    """Bytes, or numbers in [0, 1], -> numbers in [0, 1]."""
    scale = 1 / 255 if colors.dtype == torch.uint8 else 1.0
    return (colors.float() * scale).contiguous()


def _posed(
    image: Tensor, posed: Posed, temperature: TemperatureRange | None, name: str
) -> PosedImage:
    """An image in memory, undistorted if its camera has a lens."""
    camera, lens = posed
    size = (camera.height, camera.width)
    if image.shape[:2] != size:
        expected = [*size, *image.shape[2:]]
        raise ValueError(f"{name} must have shape {expected}, not {list(image.shape)}")
    if lens is not None:
        camera = Camera(matrix_of(pinhole_of(lens)), camera.viewmat, *reversed(size))
    return PosedImage(camera, partial(_load, image, temperature, lens))


def _load(image: Tensor, temperature: TemperatureRange | None, lens: Lens | None) -> Pixels:
    """Colours, or °C with a scale; valid are pixels in the lens's view with finite channels."""
    if temperature is None:
        values = _as_shares(image)
    else:
        values = temperature.from_celsius(image.float())[..., None]
    known = values.isfinite().all(dim=2)
    valid = None if known.all() else known
    values = values if valid is None else values.nan_to_num(0, 0, 0)
    if lens is not None:
        values, valid = undistort(values, valid, lens)
        if image.dtype == torch.uint8:  # as of files: then they take as little memory as before
            values = (values * 255).round_() / 255
    return Pixels(values, valid)
