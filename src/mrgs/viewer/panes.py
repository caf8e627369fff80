"""The panes of a picture: their places and cameras, the images and depths that they are painted
from, and readings of the model at one of their points."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mrgs.marks.regions import Regions
from mrgs.marks.surface import seen_depth
from mrgs.pictures.files import shown_values, to_array, to_rgb8
from mrgs.pictures.values import in_unit, range_of
from mrgs.rasterizer import Geometry, Layer, rasterize
from mrgs.render import Model, render
from mrgs.scene import (
    THERMAL,
    Blend,
    Camera,
    Modality,
    PosedImage,
    Rendering,
    TemperatureRange,
    View,
    in_order,
    metric_first,
)
from mrgs.scene.rendering import SOLID_ALPHA
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.settings import Mode, Subject
from mrgs.viewer.source import Source

PaneKind = Literal["image", "depth", "blend", "split", "photo", "difference", "uncertainty"]

_GAP_PX = 4


@dataclass(frozen=True, eq=False)
class Pane:
    """One part of the picture, with its upper left corner there in pixels: images of modalities (of
    two, the left or lower one first) through a camera as large as the pane, under a title, and the
    photo that it shows or compares with, if any."""

    kind: PaneKind
    modalities: tuple[Modality, ...]
    camera: Camera
    left: int = 0
    top: int = 0
    title: str = ""
    photo: PosedImage | None = None

    @property
    def scaled(self) -> Modality | None:
        """The one-channel modality that its colours stand for; None for colours and depth."""
        return next((each for each in reversed(self.modalities) if each.channels == 1), None)

    @property
    def own_camera(self) -> Camera:
        """The photo's camera at its own size; without a photo, the pane's."""
        return self.camera if self.photo is None else self.photo.camera


class PanePoint(NamedTuple):
    """A point of a pane: u to the right and v down, 0 to 1 over the pane."""

    pane: Pane
    u: float
    v: float

    def pixel_in(self, image: np.ndarray) -> tuple[int, int]:
        """Column and row of this place in an image of the pane, of any size."""
        return int(self.u * image.shape[1]), int(self.v * image.shape[0])

    def pixel_of(self, image: np.ndarray) -> Any:
        """The pixel of an image of the pane, of any size, at this place."""
        column, row = self.pixel_in(image)
        return image[row, column]


def fitted_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Width and height in pixels, at least 1, reduced to at most ``longest`` on the longer side."""
    scale = min(1.0, longest / max(width, height, 1))
    return max(1, round(width * scale)), max(1, round(height * scale))


def panes_of(mode: Mode, camera: Camera, view: View | None) -> tuple[Pane, ...]:
    """The panes of a mode for the browser's camera, which is as large as the picture; modes with
    photos show a captured view."""
    match mode.kind:
        case "side_by_side":  # the picture's middle columns
            K, width = camera.K.clone(), camera.width // 2
            K[0, 2] -= 0.5 * (camera.width - width)
            half = Camera(torch.as_tensor(K), camera.viewmat, width, camera.height)
            return tuple(
                Pane("image", (each,), half, left, title=Mode("image", (each,)).label)
                for each, left in zip(mode.modalities, (0, camera.width - width), strict=True)
            )
        case "photos":
            assert view is not None
            return _photo_panes(mode, view, camera.width, camera.height)
        case "difference":
            assert view is not None
            (modality,) = mode.modalities
            photo = view.images.get(modality)
            if photo is None:
                return ()
            box = (0, 0, camera.width, camera.height)
            title = f"model - {modality.title} photo {view.name}"
            return (_fitted("difference", modality, box, title, photo),)
    return (Pane(mode.kind, mode.modalities, camera),)


def _photo_panes(mode: Mode, view: View, width: int, height: int) -> tuple[Pane, ...]:
    """A row for each modality of the view: the photo, and the model from the same camera."""
    rows = [modality for modality in mode.modalities if modality in view.images]
    panes = []
    row_height = (height - _GAP_PX * (len(rows) - 1)) // max(len(rows), 1)
    half = (width - _GAP_PX) // 2
    for number, modality in enumerate(rows):
        photo, title = view.images[modality], modality.title
        top = number * (row_height + _GAP_PX)
        left_box, right_box = (0, top, half, row_height), (half + _GAP_PX, top, half, row_height)
        panes.append(_fitted("photo", modality, left_box, f"{title} photo {view.name}", photo))
        panes.append(_fitted("image", modality, right_box, f"{title}, the model", photo))
    return tuple(panes)


def _fitted(
    kind: PaneKind,
    modality: Modality,
    box: tuple[int, int, int, int],
    title: str,
    photo: PosedImage,
) -> Pane:
    """A captured image, as large as fits in the middle of the box (left, top, width, height)."""
    left, top, width, height = box
    camera = photo.camera
    scale = min(width / camera.width, height / camera.height)
    size = max(1, int(camera.width * scale)), max(1, int(camera.height * scale))
    left, top = left + (width - size[0]) // 2, top + (height - size[1]) // 2
    return Pane(kind, (modality,), camera.resized(*size), left, top, title, photo)


ShownImage: TypeAlias = UInt8[np.ndarray, "h w 3"] | Float[np.ndarray, "h w"]
"""Colours, or the values of a one-channel modality in its unit."""


@dataclass(frozen=True, eq=False)
class PaneImages:
    """Images of one pane, all of the same size: colours [h, w, 3], values in their unit or their
    differences to the photo [h, w], NaN where the photo is masked; z-depth of the model in scene
    units, NaN where it is empty, None if not known; and where model or photo show something."""

    images: Mapping[Modality, ShownImage]
    depth: Float[np.ndarray, "h w"] | None
    solid: Bool[np.ndarray, "h w"]


def render_pane(
    model: Model,
    camera: Camera,
    subject: Subject,
    as_photo_of: Camera | None = None,
    regions: Regions | None = None,
) -> PaneImages:
    """Render the modalities that the viewer shows; as the camera ``as_photo_of`` of a captured view
    would have recorded them, or the model itself with the temperatures of regions corrected."""
    rendering = render_surface(model, camera, subject, with_median_depth=bool(regions))
    depth = to_array(rendering.visible_depth())
    if as_photo_of is not None:
        rendering = subject.camera_response(rendering, as_photo_of)
    if regions is not None:
        rendering = regions.applied_to(rendering, camera)
    images = {
        modality: shown_image(modality, blend.image, subject.temperature)
        for modality, blend in rendering.items()
    }
    return PaneImages(images, depth, np.isfinite(depth))


def shown_image(
    modality: Modality, image: Float[Tensor, "h w c"], temperature: TemperatureRange | None
) -> ShownImage:
    """A modality's image [H, W, C] as colours [H, W, 3]; one channel as values [H, W]."""
    one = modality.channels == 1
    return shown_values(modality, image, temperature) if one else to_rgb8(image)


def photo_images(
    modality: Modality, photo: PosedImage, temperature: TemperatureRange | None
) -> PaneImages:
    """A photo as the images of a pane, at its own size; SceneError if it cannot be read."""
    pixels = photo.load()
    height, width = pixels.values.shape[:2]
    solid = np.ones((height, width), dtype=bool) if pixels.valid is None else pixels.valid.numpy()
    image = shown_image(modality, pixels.values, temperature)
    if modality.channels == 1:
        image = np.where(solid, image, np.nan).astype(np.float32)
    return PaneImages({modality: image}, None, solid)


def difference(modality: Modality, rendered: PaneImages, photo: PaneImages) -> PaneImages:
    """Rendered minus measured values of a one-channel modality; NaN where either has none."""
    solid = rendered.solid & photo.solid
    values = np.where(solid, rendered.images[modality] - photo.images[modality], np.nan)
    return PaneImages({modality: values.astype(np.float32)}, rendered.depth, solid)


def _blend_uncertainty(model: Model, camera: Camera, of_splats: Float[Tensor, " n"]) -> Blend:
    """Uncertainty, share that photos see, and temperature, blended with the thermal opacities."""
    means = model.gaussians.means
    with torch.no_grad():
        seen = of_splats.isfinite()
        values = model.values(THERMAL, camera.position.to(means), sh_degree=0)
        if model.radiance is not None:
            values = model.radiance.of_value(values)
        features = torch.stack([of_splats.nan_to_num(), seen.float(), values[:, 0].cpu()], dim=1)
        blend = _blend(model, camera, THERMAL, features.to(means), (0.0, 0.0, 0.0))
        if model.radiance is not None:
            blend.image[..., 2] = model.radiance.to_value(blend.image[..., 2])
        return blend


LEAST_SEEN = 0.5
"""A pixel of which less was seen by a thermal photo has no value."""


class UncertaintyPictures:
    """Draws the uncertainty: computed once at each splat that a thermal photo sees, then blended as
    temperatures are; by the board's present meter and regions."""

    def __init__(
        self, board: MarkBoard, source: Source, temperature: TemperatureRange | None
    ) -> None:
        self._board = board
        self._source = source
        self._temperature = temperature
        self._of_splats: tuple[Tensor, Float[Tensor, " n"]] | None = None  # and their means
        self._lock = threading.Lock()

    def images(self, camera: Camera) -> PaneImages:
        """The uncertainty in the unit of the temperatures; NaN where no thermal photo looked. The
        first call renders all thermal photos. SceneError if a photo cannot be read."""
        meter = self._board.uncertainty
        assert meter is not None
        with self._lock:
            means = self._source.run(lambda model: model.gaussians.means)
            if self._of_splats is None or self._of_splats[0] is not means:
                found = meter.of_photos(means.detach().cpu().float().numpy())
                self._of_splats = means, torch.from_numpy(found)
            _, of_splats = self._of_splats
        blend, depth = self._source.run(
            lambda model: (_blend_uncertainty(model, camera, of_splats), _depth(model, camera))
        )
        alpha = blend.alpha.clamp_min(SOLID_ALPHA)
        doubt, seen, value = (blend.image[..., i].double().numpy() for i in range(3))
        solid = (blend.alpha.numpy() >= SOLID_ALPHA) & (seen >= LEAST_SEEN * alpha.numpy())
        of_photos = np.where(solid, doubt / np.maximum(seen, 1e-9), np.nan)
        if self._temperature is not None:
            value = self._temperature.to_celsius(value)
        # The depths by which ``Regions.applied_to`` decides what is on a region: an area whose
        # temperatures are corrected has the uncertainty of corrected ones throughout.
        points = camera.unproject_image(torch.from_numpy(depth)).numpy()
        eye = camera.position.double().numpy()
        total = meter.together(of_photos, points, value, self._board.regions, eye)
        return PaneImages({THERMAL: total.astype(np.float32)}, depth, solid)


def _depth(model: Model, camera: Camera) -> Float[np.ndarray, "h w"]:
    """z-depths of the thermal surface, as pictures of temperatures have them."""
    with torch.no_grad():
        return seen_depth(render(model, {THERMAL: camera}, with_median_depth=True)[0])


def _blend(
    model: Model,
    camera: Camera,
    modality: Modality,
    values: Float[Tensor, "n c"],
    background: Sequence[float],
) -> Blend:
    """Σ w_i values_i + T_end · background of every pixel, w_i by a modality's opacities."""
    gaussians = model.gaussians
    with torch.no_grad():
        layer = Layer(gaussians.opacity(modality), values, values.new_tensor(background))
        projection = model.dilation.projection(camera, values.device)
        return rasterize(Geometry.of(gaussians), [layer], projection).blends[0]


@dataclass(frozen=True)
class ValueReading:
    """The value of one modality at a pixel, and the standard deviation of the values of what makes
    up the pixel; in the modality's unit (normalised without one)."""

    value: float
    deviation: float


@dataclass(frozen=True, eq=False)
class Reading:
    """The model's values at a point: z-depth from the camera that it was read through, and the
    standard deviation of the depths of the pixel's splats, scene units."""

    position: Float[np.ndarray, "3"]
    depth: float
    depth_deviation: float
    values: Mapping[Modality, ValueReading]


def read_point(
    model: Model,
    camera: Camera,
    u: float,
    v: float,
    subject: Subject,
    regions: Regions | None = None,
) -> Reading | None:
    """Read the pixel under a point of the image; None where the model is empty.

    A value is that of the rendered image. Its deviation is the standard deviation, over all that
    makes up the pixel with its blending weights w_i (the splats, and the background with T_end), of
    their own values; that of the depth is over the splats. It is large where the model mixes much,
    at an edge or where its surface is not thin. It is not an error bar against the true value.

    Args:
        u: to the right, 0 to 1 over the image.
        v: down, 0 to 1 over the image.
        regions: surfaces with an emissivity of their own; None reads what the photos have.
    """
    width, height = camera.width, camera.height
    column, row = min(int(u * width), width - 1), min(int(v * height), height - 1)
    with torch.no_grad():
        rendering = render_surface(model, camera, subject)
        depth = rendering.visible_depth()[row, column].item()
        if not math.isfinite(depth):
            return None
        if regions is not None:
            rendering = regions.applied_to(rendering, camera)
        means = model.gaussians.means

        def deviation(modality: Modality, squares: Float[Tensor, " n"], beyond: float) -> float:
            blend = _blend(model, camera, modality, squares[:, None], (beyond,))
            return math.sqrt(max(blend.image[row, column, 0].item(), 0.0))

        values = {}
        for modality in subject.readable:
            value = rendering[modality].image[row, column, 0].item()
            own = model.values(modality, camera.position.to(means))[:, 0]
            low, high = range_of(modality, subject.temperature)
            values[modality] = ValueReading(
                in_unit(modality, value, subject.temperature),
                (high - low) * deviation(modality, (own - value).square(), value**2),
            )
        alphas = {each: rendering[each].alpha[row, column].item() for each in rendering}
        # The pixel has a depth, so one modality covers it: the blend that gives the depth.
        surface = next(each for each in metric_first(rendering) if alphas[each] >= SOLID_ALPHA)
        viewmat = camera.viewmat.to(means)
        squares = (means @ viewmat[2, :3] + viewmat[2, 3] - depth).square()
        depth_deviation = deviation(surface, squares, 0.0) / math.sqrt(alphas[surface])
    pixel = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64)
    position = camera.unproject(pixel, pixel.new_tensor(depth)).numpy()
    return Reading(position, depth, depth_deviation, values)


def render_surface(
    model: Model, camera: Camera, subject: Subject, with_median_depth: bool = True
) -> Rendering:
    """The modalities that are shown, with the median depths of their surfaces."""
    cameras = dict.fromkeys(in_order(subject.modalities), camera)
    with torch.no_grad():
        return render(model, cameras, with_median_depth=with_median_depth)[0]
