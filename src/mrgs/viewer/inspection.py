"""State and actions of one viewer session, without a browser: pictures, readings, spots, boxes,
camera paths."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mrgs.errors import ConfigError
from mrgs.pictures.files import write_png
from mrgs.pictures.video import VIDEO_FPS, can_write_mp4, frame_writer
from mrgs.scene import Camera, Modality, View
from mrgs.viewer.cameras import fitted_size, nearest_view, save_path, smooth_path
from mrgs.viewer.fields import PaneImages, difference, photo_images, render_pane
from mrgs.viewer.layout import Pane, panes_of, place_at
from mrgs.viewer.painting import Mark, Scales, compose, measure_scales
from mrgs.viewer.picking import Box, BoxReading, Reading, read_box, read_point
from mrgs.viewer.settings import Settings, Subject

COARSE_SIDE_PX = 400
"""Longest side that is rendered while the camera moves."""

VIDEO_SIDE_PX = 960
PHOTOS_KEPT = 4


@dataclass(frozen=True, eq=False)
class DrawnPicture:
    """The latest picture.

    Attributes:
        size: width and height, pixels.
        panes: its parts.
        images: what each pane was painted from.
    """

    size: tuple[int, int]
    panes: tuple[Pane, ...]
    images: tuple[PaneImages, ...]


@dataclass(frozen=True, eq=False)
class PointReading:
    """A reading at a point of a pane.

    Attributes:
        reading: of the model.
        modality: the one whose value is named first; None for a model without readable values.
        photo_value: what the pane's photo has there, in the unit of ``modality``; None where no
            photo of it is shown.
    """

    reading: Reading
    modality: Modality | None
    photo_value: float | None

    @property
    def value(self) -> float | None:
        """The value of ``modality`` in its unit."""
        return None if self.modality is None else self.reading.values[self.modality].value


class Inspection:
    """State and actions of one browser. Pictures are drawn on one thread; actions may come from
    others.

    Attributes:
        subject: the model.
        settings: the choices that the next picture is drawn with.
        camera: of the latest picture, at its size; None before the first.
        view_index: of the captured view nearest to it, in ``subject.views``.
        point: the latest reading.
        spots: points that were kept as labelled marks.
        boxes: rectangles that were drawn.
        box_readings: one per box, of the latest sharp picture; None for a box without values.
        keyframes: of the camera path.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.settings = Settings(mode=subject.modes[0])
        self.camera: Camera | None = None
        self.view_index: int | None = None
        self.point: PointReading | None = None
        self.spots: tuple[Mark, ...] = ()
        self.boxes: tuple[Box, ...] = ()
        self.box_readings: tuple[BoxReading | None, ...] = ()
        self.keyframes: tuple[Camera, ...] = ()
        self._picture: DrawnPicture | None = None
        self._scales = Scales()
        self._photos: dict[int, PaneImages] = {}
        self._photo_lock = threading.Lock()
        self._ball = None if subject.scene is None else subject.scene.reach

    @property
    def view(self) -> View | None:
        """The captured view that the modes with photos show."""
        return None if self.view_index is None else self.subject.views[self.view_index]

    @property
    def measured(self) -> Modality | None:
        """The modality that boxes read: that of the mode, else the subject's first readable one."""
        return _first_readable((*reversed(self.settings.mode.modalities), *self.subject.readable))

    @property
    def scales(self) -> Scales:
        """The colour scales of the latest sharp picture."""
        return self._scales

    def picture(self, camera: Camera, coarse: bool) -> UInt8[np.ndarray, "h w 3"]:
        """Draw what the camera sees; the modes with photos show the captured camera nearest to it.

        Args:
            camera: the browser's, as large as its window.
            coarse: few pixels, and the scales of the last sharp picture, so that colours do not
                flicker on the way.
        """
        camera = camera.resized(
            *fitted_size(camera.width, camera.height, self.subject.source.max_side_px)
        )
        if self.subject.scene is not None:
            self.view_index = nearest_view(
                self.subject.views, camera, self.subject.scene.extent, self.view_index
            )
        settings = self.settings
        drawn = self._render(settings, camera, COARSE_SIDE_PX if coarse else None)
        scales = self._measure(drawn, settings)
        if coarse:
            scales = _known(self._scales, scales, settings)
        boxes = [
            (box, [self._box_reading(each, box) for each in drawn.images]) for box in self.boxes
        ]
        image = compose(
            drawn.size, drawn.panes, drawn.images, scales, settings, self._marks(), boxes
        )
        self.camera, self._picture = camera, drawn
        if not coarse:
            self._scales = scales
            self.box_readings = tuple(next(filter(None, readings), None) for _, readings in boxes)
        self.subject.source.charge()
        return image

    def _render(self, settings: Settings, camera: Camera, longest: int | None) -> DrawnPicture:
        panes = panes_of(settings.mode, camera, self.view)
        scale = 1.0 if longest is None else min(1.0, longest / max(camera.width, camera.height))
        images = tuple(self._images(pane, scale) for pane in panes)
        return DrawnPicture((camera.width, camera.height), panes, images)

    def _measure(self, drawn: DrawnPicture, settings: Settings) -> Scales:
        return measure_scales(
            drawn.panes, drawn.images, settings, self.subject.temperature, self._ball
        )

    def _images(self, pane: Pane, scale: float) -> PaneImages:
        subject = self.subject
        if pane.kind == "photo":
            return self._photo(pane)
        camera = pane.camera
        compared_with = None
        if pane.kind == "difference":
            assert pane.photo is not None
            assert self.view is not None
            camera, compared_with = pane.photo.camera, self.view.camera
        elif scale < 1:
            camera = camera.resized(
                max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
            )
        images = subject.source.run(
            lambda model: render_pane(model, camera, subject, compared_with)
        )
        if compared_with is None:
            return images
        (modality,) = pane.modalities
        return difference(modality, images, self._photo(pane))

    def _photo(self, pane: Pane) -> PaneImages:
        """The pane's photo; the last few are kept."""
        assert pane.photo is not None
        (modality,) = pane.modalities
        key = id(pane.photo)
        with self._photo_lock:
            if key not in self._photos:
                self._photos[key] = photo_images(modality, pane.photo, self.subject.temperature)
                while len(self._photos) > PHOTOS_KEPT:
                    del self._photos[next(iter(self._photos))]
            return self._photos[key]

    def _box_reading(self, images: PaneImages, box: Box) -> BoxReading | None:
        """What a pane shows in a box of ``measured``; None for a pane without its values."""
        if self.measured is None or self.measured not in images.images:
            return None
        return read_box(images.images[self.measured], images.solid, box)

    def _marks(self) -> list[Mark]:
        point = self.point
        if point is None:
            return list(self.spots)
        return [*self.spots, Mark(point.reading.position, self._value_text(point) or "point")]

    def _value_text(self, point: PointReading) -> str:
        """The value that is named first; empty for a model without readable values."""
        if point.modality is None or point.value is None:
            return ""
        return self.subject.format_value(point.modality, point.value)

    def click(self, x: float, y: float) -> PointReading | None:
        """Read the point under a place of the latest picture (x to the right, y down, 0 to 1); None
        if it is empty."""
        self.point = None
        drawn = self._picture
        place = (
            None if drawn is None else place_at(drawn.panes, x * drawn.size[0], y * drawn.size[1])
        )
        if place is None:
            return None
        pane, subject = place.pane, self.subject
        camera = pane.photo.camera if pane.photo is not None else pane.camera
        reading = subject.source.run(
            lambda model: read_point(model, camera, place.u, place.v, subject)
        )
        if reading is not None:
            modality = _first_readable((*reversed(pane.modalities), *subject.readable))
            photo_value = self._photo_value(pane, place.u, place.v)
            self.point = PointReading(reading, modality, photo_value)
        return self.point

    def _photo_value(self, pane: Pane, u: float, v: float) -> float | None:
        """What the pane's photo has at a place, in its unit; None for colours or no photo."""
        if pane.photo is None or pane.scaled is None:
            return None
        values = self._photo(pane).images[pane.scaled]
        value = float(values[int(v * values.shape[0]), int(u * values.shape[1])])
        return value if np.isfinite(value) else None

    def keep_spot(self) -> None:
        """Keep the point that was read last as a numbered spot.

        Raises:
            ConfigError: no point has been read.
        """
        if self.point is None:
            raise ConfigError("click on the picture first, then keep the point as a spot")
        label = f"S{len(self.spots) + 1}  {self._value_text(self.point)}".rstrip()
        spot = Mark(self.point.reading.position, label)
        self.spots, self.point = (*self.spots, spot), None

    def add_box(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Add a box over a rectangle of the latest picture, corners 0 to 1; it stays at its place
        of the pane.

        Raises:
            ConfigError: the rectangle does not begin in the picture, or is a mere line.
        """
        drawn = self._picture
        (x0, x1), (y0, y1) = sorted((x0, x1)), sorted((y0, y1))
        place = None
        if drawn is not None:
            middle = 0.5 * (x0 + x1) * drawn.size[0], 0.5 * (y0 + y1) * drawn.size[1]
            place = place_at(drawn.panes, *middle)
        if drawn is None or place is None or x1 - x0 < 0.005 or y1 - y0 < 0.005:
            raise ConfigError("drag a larger box within the picture")
        pane = place.pane
        u0, u1 = ((x * drawn.size[0] - pane.left) / pane.camera.width for x in (x0, x1))
        v0, v1 = ((y * drawn.size[1] - pane.top) / pane.camera.height for y in (y0, y1))
        self.boxes = (*self.boxes, Box(max(u0, 0.0), max(v0, 0.0), min(u1, 1.0), min(v1, 1.0)))

    def clear(self) -> None:
        """Remove the point, the spots and the boxes."""
        self.point, self.spots, self.boxes, self.box_readings = None, (), (), ()

    def add_keyframe(self) -> None:
        """Add the current camera to the path.

        Raises:
            ConfigError: no picture has been drawn yet.
        """
        if self.camera is None:
            raise ConfigError("wait for the first picture, then add a keyframe")
        self.keyframes = (*self.keyframes, self.camera)

    def screenshot(self) -> Path:
        """Write the current view, sharp and with its marks, into ``renders/screenshots``; returns
        the file.

        Raises:
            ConfigError: no picture has been drawn yet.
            RunError: the file cannot be written.
        """
        if self.camera is None:
            raise ConfigError("wait for the first picture, then take a screenshot")
        folder = self.subject.folder / "renders" / "screenshots"
        return write_png(_next_free(folder, ".png"), self.picture(self.camera, coarse=False))

    def save_path(self, seconds: float) -> Path:
        """Write the keyframes into ``renders/paths``, in nerfstudio's format; returns the file.

        Raises:
            ConfigError: there are no keyframes.
            RunError: the file cannot be written.
        """
        folder = self.subject.folder / "renders" / "paths"
        return save_path(_next_free(folder, ".json"), self.keyframes, seconds, VIDEO_FPS)

    def render_video(
        self, seconds: float, progress: Callable[[int, int], None], mp4: bool | None = None
    ) -> Path:
        """Render the path with the current settings into ``renders/videos``; returns the mp4, or
        the frames' folder.

        The colour scale is the current one throughout. Spots are drawn, boxes are not.

        Args:
            seconds: length of the video.
            progress: called with the number of frames done and of all.
            mp4: whether to write one; None writes it if imageio-ffmpeg is installed.

        Raises:
            ConfigError: fewer than two keyframes, or a mode that is bound to photos.
            RunError: a file cannot be written.
        """
        if self.settings.mode.shows_photos:
            raise ConfigError(
                "a video needs a free camera: choose another picture than those with photos"
            )
        path = smooth_path(self.keyframes, round(seconds * VIDEO_FPS))
        size = fitted_size(path[0].width, path[0].height, VIDEO_SIDE_PX)
        folder = self.subject.folder / "renders" / "videos"
        target = _next_free(folder, "")
        mp4 = can_write_mp4() if mp4 is None else mp4
        with frame_writer(folder, target.name, size, mp4=mp4) as add:
            for frame in self._video_frames([camera.resized(*size) for camera in path], progress):
                add(frame)
        return target.with_suffix(".mp4") if mp4 else target

    def _video_frames(
        self, cameras: Sequence[Camera], progress: Callable[[int, int], None]
    ) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        settings, scales, marks = self.settings, self._scales, self.spots
        for number, camera in enumerate(cameras, start=1):
            drawn = self._render(settings, camera, None)
            scales = _known(scales, self._measure(drawn, settings), settings)
            yield compose(drawn.size, drawn.panes, drawn.images, scales, settings, marks)
            self.subject.source.charge()
            progress(number, len(cameras))


def _known(known: Scales, measured: Scales, settings: Settings) -> Scales:
    """The known scales; the measured ones where there is none, or where the user's choices have
    changed."""
    values = dict(known.values)
    for modality, scale in measured.values.items():
        kept = values.get(modality)
        by_hand = settings.limits is not None and modality == settings.scaled
        values[modality] = (
            scale if kept is None or by_hand else kept._replace(palette=scale.palette)
        )
    return Scales(values, known.depth or measured.depth, known.difference or measured.difference)


def _first_readable(modalities: Sequence[Modality]) -> Modality | None:
    return next((each for each in modalities if each.channels == 1), None)


def _next_free(folder: Path, suffix: str) -> Path:
    """``FOLDER/0001`` with the first number that no file or folder has."""
    number = 1
    while any(folder.glob(f"{number:04d}*")):
        number += 1
    return folder / f"{number:04d}{suffix}"
