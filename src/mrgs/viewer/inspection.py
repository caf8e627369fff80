"""State and actions of one viewer session, without a browser: pictures, readings, marks,
keyframes."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from mrgs.errors import ConfigError
from mrgs.marks.mark import MarkKind
from mrgs.marks.measure import MarkReading
from mrgs.marks.regions import Regions
from mrgs.marks.texts import label_text
from mrgs.pictures.page_data import rounded
from mrgs.scene import Camera, Modality, View
from mrgs.viewer.annotation import Outline, PointLabel, annotate
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.painting import Scales, compose, measure_scales
from mrgs.viewer.panes import (
    Pane,
    PaneImages,
    Place,
    difference,
    panes_of,
    photo_images,
    place_at,
    render_pane,
)
from mrgs.viewer.picking import Reading, read_point
from mrgs.viewer.settings import Settings, Subject

PHOTOS_KEPT = 4


@dataclass(frozen=True, eq=False)
class DrawnPicture:
    """A picture, and what it was painted from.

    Attributes:
        camera: that it was drawn from, at its size.
        pixels: the colours, without marks and scales, [H, W, 3].
    """

    camera: Camera
    panes: tuple[Pane, ...]
    images: tuple[PaneImages, ...]
    scales: Scales
    pixels: UInt8[np.ndarray, "h w 3"]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.camera.width, self.camera.height


@dataclass(frozen=True, eq=False)
class PointReading:
    """A reading at a point of a pane.

    Attributes:
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
        settings: the choices that the next picture is drawn with.
        drawn: the latest picture; None before the first.
        view_index: of the captured view nearest to it, in ``subject.views``.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.settings = Settings(
            mode=subject.modes[0],
            limits=subject.limits,
            scaled=subject.scaled or subject.modalities[0],
        )
        self.drawn: DrawnPicture | None = None
        self.view_index: int | None = None
        self.point: PointReading | None = None
        self.keyframes: tuple[Camera, ...] = ()
        self._scales = Scales()
        self._photos: dict[int, PaneImages] = {}
        self._photo_lock = threading.Lock()
        self._ball = None if subject.scene is None else subject.scene.reach

    @property
    def view(self) -> View | None:
        """The captured view that the modes with photos show."""
        return None if self.view_index is None else self.subject.views[self.view_index]

    def picture(self, camera: Camera, moving: bool = False) -> DrawnPicture:
        """Draw what the camera sees; the modes with photos show the captured camera nearest to it.

        Args:
            camera: of the picture, at its size.
            moving: whether the next camera is on its way: then the scales that follow the picture
                stay those of the last picture at rest, so that colours do not flicker.
        """
        if self.subject.scene is not None:
            self.view_index = nearest_view(
                self.subject.views, camera, self.subject.scene.extent, self.view_index
            )
        settings = self.settings
        panes, images = self._render(settings, camera, moving)
        scales = self._measure(panes, images, settings)
        if moving:
            scales = _known(self._scales, scales, settings)
        else:
            self._scales = scales
        size = camera.width, camera.height
        pixels = compose(size, panes, images, scales, settings)
        self.drawn = DrawnPicture(camera, panes, images, scales, pixels)
        return self.drawn

    def fit(self) -> None:
        """Lock the scale of each modality that is shown at the limits of what the latest picture
        shows."""
        drawn = self.drawn
        if drawn is not None:
            measured = self._measure(drawn.panes, drawn.images, replace(self.settings, limits={}))
            fitted = {
                modality: rounded(modality, (scale.low, scale.high), self.subject.temperature)
                for modality, scale in measured.values.items()
                if modality.is_metric
            }
            self.settings = replace(self.settings, limits={**self.settings.limits, **fitted})

    def marks(self) -> list[PointLabel]:
        """The spots, and the point that was read last."""
        labels = [
            PointLabel(
                np.array(reading.mark.points[0]),
                label_text(reading, self.subject.temperature),
                reading.mark.name,
            )
            for reading in self._readings
            if reading.mark.kind == "spot"
        ]
        point = self.point
        if point is not None:
            labels.append(PointLabel(point.reading.position, self._value_text(point) or "point"))
        return labels

    def proposals(self) -> list[PointLabel]:
        """The anomalies that the report proposes."""
        board, temperature = self._board, self.subject.temperature
        return [
            PointLabel(
                np.array(reading.mark.points[0]),
                f"{label_text(reading, temperature)} ?",
                f"{reading.mark.name} ?",
            )
            for reading in (() if board is None else board.proposals)
        ]

    def outlines(self) -> list[Outline]:
        """The lines and the areas."""
        return [
            Outline(
                np.array(reading.mark.points),
                reading.mark.is_area,
                label_text(reading, self.subject.temperature),
                reading.low_at,
                reading.high_at,
                reading.mark.name,
            )
            for reading in self._readings
            if reading.mark.kind != "spot"
        ]

    @property
    def _readings(self) -> Sequence[MarkReading]:
        return () if self._board is None else self._board.readings

    @property
    def _board(self) -> MarkBoard | None:
        """The marks, if they are to be drawn."""
        return self.subject.board if self.settings.marks else None

    def add_mark(self, kind: MarkKind, points: Sequence[tuple[float, float]]) -> None:
        """Add a mark through places of the latest picture, from 0 to 1, and save it.

        Args:
            points: two opposite corners of a box; the corners of the others.

        Raises:
            ConfigError: a place lies outside the picture, or shows no surface.
            SceneError: a photo cannot be read.
            RunError: the mark cannot be saved.
        """
        board = self.subject.board
        if board is None:
            raise ConfigError("marks need the scene: open the run with it")
        if kind == "box" and len(points) != 2:
            raise ConfigError("draw a box from one corner to the opposite one")
        places = [place for x, y in points if (place := self._place(x, y)) is not None]
        pane = places[0].pane if places else None
        if pane is None or len(places) < len(points) or any(p.pane is not pane for p in places):
            raise ConfigError("draw the mark within one picture")
        camera = pane.photo.camera if pane.photo is not None else pane.camera
        pixels = [(place.u * camera.width, place.v * camera.height) for place in places]
        board.draw(kind, camera, pixels)
        self.point = None

    def _render(
        self, settings: Settings, camera: Camera, moving: bool = False
    ) -> tuple[tuple[Pane, ...], tuple[PaneImages, ...]]:
        panes = panes_of(settings.mode, camera, self.view)
        return panes, tuple(self._images(pane, moving) for pane in panes)

    def _measure(
        self, panes: Sequence[Pane], images: Sequence[PaneImages], settings: Settings
    ) -> Scales:
        return measure_scales(panes, images, settings, self.subject.temperature, self._ball)

    def _images(self, pane: Pane, moving: bool) -> PaneImages:
        subject = self.subject
        if pane.kind == "photo":
            return self._photo(pane)
        if pane.kind == "uncertainty":
            assert subject.uncertainty is not None
            images: PaneImages = subject.uncertainty(pane.camera)
            return images
        camera = pane.camera
        compared_with = None
        if pane.kind == "difference":
            assert pane.photo is not None
            assert self.view is not None
            camera, compared_with = pane.photo.camera, self.view.camera
        regions = self._regions(pane)
        images = subject.source.run(
            lambda model: render_pane(model, camera, subject, compared_with, regions),
            camera if moving else None,
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

    def _regions(self, pane: Pane) -> Regions | None:
        """Surfaces with an emissivity of their own; None beside photos, which have none."""
        board = self.subject.board
        return None if board is None or pane.photo is not None else board.regions

    def _value_text(self, point: PointReading) -> str:
        """The value that is named first; empty for a model without readable values."""
        if point.modality is None or point.value is None:
            return ""
        return self.subject.format_value(point.modality, point.value)

    def click(self, x: float, y: float) -> PointReading | None:
        """Read the point under a place of the latest picture (x to the right, y down, 0 to 1); None
        if it is empty."""
        self.point = None
        place = self._place(x, y)
        if place is None:
            return None
        pane, subject = place.pane, self.subject
        camera = pane.photo.camera if pane.photo is not None else pane.camera
        reading = subject.source.run(
            lambda model: read_point(model, camera, place.u, place.v, subject, self._regions(pane))
        )
        if reading is not None:
            modality = _first_readable((*reversed(pane.modalities), *subject.readable))
            photo_value = self._photo_value(pane, place.u, place.v)
            self.point = PointReading(reading, modality, photo_value)
        return self.point

    def hover(self, x: float, y: float) -> str:
        """What the latest picture shows at a place (x to the right, y down, 0 to 1), as text; empty
        where it shows no value."""
        place, drawn = self._place(x, y), self.drawn
        if place is None or drawn is None:
            return ""
        pane, shown = place.pane, drawn.images[drawn.panes.index(place.pane)]
        modality = _first_readable((*reversed(pane.modalities), *self.subject.readable))
        values = None if modality is None else shown.images.get(modality)
        if modality is None or values is None:
            return ""
        row, column = int(place.v * values.shape[0]), int(place.u * values.shape[1])
        value = float(values[row, column])
        if not shown.solid[row, column] or not np.isfinite(value):
            return "no surface"
        if pane.kind not in ("uncertainty", "difference"):
            return self.subject.format_value(modality, value)
        if pane.kind == "uncertainty":
            return f"± {self.subject.format_difference(modality, value)}"
        return self.subject.format_difference(modality, value, sign=True)

    def _place(self, x: float, y: float) -> Place | None:
        """The pane and the place in it at a place of the latest picture; None between the panes."""
        drawn = self.drawn
        if drawn is None:
            return None
        return place_at(drawn.panes, x * drawn.size[0], y * drawn.size[1])

    def _photo_value(self, pane: Pane, u: float, v: float) -> float | None:
        """What the pane's photo has at a place, in its unit; None for colours or no photo."""
        if pane.photo is None or pane.scaled is None:
            return None
        values = self._photo(pane).images[pane.scaled]
        value = float(values[int(v * values.shape[0]), int(u * values.shape[1])])
        return value if np.isfinite(value) else None

    def add_keyframe(self) -> None:
        """Add the current camera to the path.

        Raises:
            ConfigError: no picture has been drawn yet.
        """
        if self.drawn is None:
            raise ConfigError("wait for the first picture, then add a keyframe")
        self.keyframes = (*self.keyframes, self.drawn.camera)

    def annotated_pictures(self, cameras: Sequence[Camera]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Pictures of a path with their marks, by the current settings and scales throughout."""
        self.point = None
        settings, scales = self.settings, self._scales
        marks, outlines = self.marks(), self.outlines()
        for camera in cameras:
            panes, images = self._render(settings, camera)
            scales = _known(scales, self._measure(panes, images, settings), settings)
            size = camera.width, camera.height
            pixels = compose(size, panes, images, scales, settings)
            yield annotate(pixels, panes, images, scales, marks, outlines)


def _known(known: Scales, measured: Scales, settings: Settings) -> Scales:
    """The known scales; the measured ones where there is none, or where the user's choices have
    changed."""
    values = dict(known.values)
    for modality, scale in measured.values.items():
        kept = values.get(modality)
        locked = modality in settings.limits
        values[modality] = scale if kept is None or locked else kept._replace(palette=scale.palette)
    return Scales(
        values,
        known.depth or measured.depth,
        known.difference or measured.difference,
        known.uncertainty or measured.uncertainty,
    )


def _first_readable(modalities: Sequence[Modality]) -> Modality | None:
    return next((each for each in modalities if each.channels == 1), None)


def nearest_view(
    views: Sequence[View], camera: Camera, extent: float, preferred: int | None = None
) -> int:
    """Index of the captured view whose position and direction are closest to a camera's; ties go to
    ``preferred``.

    Args:
        extent: of the scene; a way of this length weighs as much as a right angle.
        preferred: index of the view shown now.
    """
    costs = []
    for index, view in enumerate(views):
        other = view.camera
        way = (other.position - camera.position).norm().item() / extent
        turn = 1 - (other.forward @ camera.forward).item()
        costs.append(way + turn - (1e-3 if index == preferred else 0.0))
    return int(np.argmin(costs))
