"""State and actions of a viewer session, without browser: pictures, readings, marks, keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, UInt8

from mrgs.errors import ConfigError
from mrgs.marks.mark import MarkKind
from mrgs.marks.measure import MarkReading
from mrgs.marks.regions import Regions
from mrgs.marks.tables import label_text
from mrgs.pictures.page_data import rounded
from mrgs.pictures.palette import PaletteName
from mrgs.scene import THERMAL, Box, Camera, Modality, View
from mrgs.survey import Survey
from mrgs.viewer.painting import DrawnPicture, MarkLabel, Scales, annotate, compose, measure_scales
from mrgs.viewer.panes import (
    Pane,
    PaneImages,
    PanePoint,
    Reading,
    difference,
    panes_of,
    photo_images,
    read_point,
    render_pane,
)
from mrgs.viewer.settings import Settings, Subject

PHOTOS_KEPT = 4

BOX_STEPS, SEEN_PERCENT, MARGIN = 300, (1.0, 99.0), 0.05
"""Of a box to keep: places across, percentiles of their surface, share of its longest side."""


@dataclass(frozen=True, eq=False)
class PointReading:
    """A reading at a point of a pane; the modality whose value is named first, if any has a
    readable one, and the value of the pane's photo there, if it is shown, in its unit."""

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
        stated = Survey() if subject.board is None else subject.board.survey
        limits = dict(subject.limits)
        if THERMAL in limits and subject.temperature is not None and stated.scale is not None:
            limits[THERMAL] = stated.scale
        palette: PaletteName = stated.palette or Settings.palette
        scaled = subject.scaled or subject.modalities[0]
        self.settings = Settings(subject.modes[0], palette, limits, scaled=scaled)
        self.drawn: DrawnPicture | None = None
        self.view_index: int | None = None
        self.point: PointReading | None = None
        self.keyframes: tuple[Camera, ...] = ()
        self._scales: Scales = {}
        self._photo_images = lru_cache(PHOTOS_KEPT)(photo_images)
        self._ball = None if subject.scene is None else subject.scene.reach

    @property
    def view(self) -> View | None:
        """The captured view that the modes with photos show."""
        return None if self.view_index is None else self.subject.views[self.view_index]

    def picture(self, camera: Camera, moving: bool = False) -> DrawnPicture:
        """Draw what the camera sees, at its size; the modes with photos show the captured camera
        nearest to it. While it is ``moving``, scales that follow the picture stay those of the last
        picture at rest, so that colours do not flicker."""
        if self.subject.scene is not None:
            self.view_index = nearest_view(
                self.subject.views, camera, self.subject.scene.extent, self.view_index
            )
        self.drawn = self._draw(camera, self.settings, self._scales if moving else {}, moving)
        if not moving:
            self._scales = self.drawn.scales
        return self.drawn

    def _draw(
        self, camera: Camera, settings: Settings, known: Scales, moving: bool = False
    ) -> DrawnPicture:
        """A picture in known scales, or in measured ones where there are none, or where the user's
        choices have changed."""
        panes = tuple(map(self._titled, panes_of(settings.mode, camera, self.view)))
        images = tuple(self._images(pane, moving) for pane in panes)
        # What hides a mark in a photo is known from the model beside it.
        depths = {pane.photo: shown.depth for pane, shown in zip(panes, images, strict=True)}
        images = tuple(
            replace(shown, depth=depths[pane.photo]) if pane.kind == "photo" else shown
            for pane, shown in zip(panes, images, strict=True)
        )
        scales = dict(known)
        for key, scale in self._measured(panes, images, settings).items():
            kept = scales.get(key)
            if kept is None or key in settings.limits:
                scales[key] = scale
            elif isinstance(key, Modality):
                scales[key] = kept._replace(palette=scale.palette)
        pixels = compose((camera.width, camera.height), panes, images, scales, settings)
        return DrawnPicture(camera, panes, images, scales, pixels)

    def _measured(
        self, panes: Sequence[Pane], images: Sequence[PaneImages], settings: Settings
    ) -> Scales:
        return measure_scales(panes, images, settings, self.subject.temperature, self._ball)

    def fit(self) -> None:
        """Lock the scale of each shown modality at the limits of the latest picture."""
        drawn = self.drawn
        if drawn is not None:
            free = replace(self.settings, limits={})
            fitted = {
                key: rounded(key, (scale.low, scale.high), self.subject.temperature)
                for key, scale in self._measured(drawn.panes, drawn.images, free).items()
                if isinstance(key, Modality) and key.is_metric
            }
            self.settings = replace(self.settings, limits={**self.settings.limits, **fitted})

    def labels(self, with_proposals: bool = False) -> list[MarkLabel]:
        """The lines and areas, the spots, the point that was read last, and the places that the
        report proposes, with a question mark."""
        board, point = self.subject.board if self.settings.marks else None, self.point

        def label(reading: MarkReading, doubt: str = "") -> MarkLabel:
            mark, text = reading.mark, label_text(reading, self.subject.temperature)
            ends = ((), ()) if mark.kind == "spot" else (reading.low_at, reading.high_at)
            return MarkLabel(
                np.array(mark.points), text + doubt, mark.name + doubt, mark.is_area, *ends
            )

        labels = [label(each) for each in (() if board is None else board.readings)]
        labels.sort(key=lambda label: len(label.corners) == 1)
        if point is not None:
            text = "point"
            if point.modality is not None and point.value is not None:
                text = self.subject.format_value(point.modality, point.value)
            labels.append(MarkLabel(point.reading.position[None], text))
        proposals = board.proposals if board is not None and with_proposals else ()
        return labels + [label(each, " ?") for each in proposals]

    def add_mark(self, kind: MarkKind, points: Sequence[tuple[float, float]]) -> None:
        """Add a mark through places of the latest picture, from 0 to 1, of a box two opposite
        corners, and save it. ConfigError if a place is outside the picture, or shows no surface;
        SceneError if a photo cannot be read; RunError if the mark cannot be saved."""
        board = self.subject.board
        if board is None:
            raise ConfigError("marks need the scene: open the run with it")
        pane, places = self._places(kind, points)
        camera = pane.own_camera
        pixels = [(place.u * camera.width, place.v * camera.height) for place in places]
        picked = board.picker.pick(kind, camera, pixels)
        board.edit(lambda marks: marks.adding(kind, **picked))
        self.point = None

    def box_of(self, kind: MarkKind, points: Sequence[tuple[float, float]]) -> Box:
        """The box around the surface that the latest picture shows between two places, from 0 to 1;
        or all above, below and within an outline through places, whose corners are as deep as most
        of the surface where there is none. ConfigError as for ``add_mark``."""
        pane, places = self._places(kind, points)
        assert self.drawn is not None
        depth = self.drawn.images[self.drawn.panes.index(pane)].depth
        depth = np.full((1, 1), np.nan) if depth is None else depth
        camera = pane.camera.resized(*depth.shape[::-1])
        if self._ball is not None:
            depth = self._ball.without_background(camera, torch.from_numpy(depth)).numpy()
        pixels = np.array([place.pixel_in(depth) for place in places])
        if kind == "box":
            across = np.linspace(pixels[0], pixels[1], BOX_STEPS).astype(int)
            pixels = np.stack(np.meshgrid(*across.T), axis=-1).reshape(-1, 2)
            pixels = pixels[np.isfinite(depth[pixels[:, 1], pixels[:, 0]])]
        if not len(pixels) or not np.isfinite(depth).any():
            raise ConfigError("no surface is seen there: draw over the model")
        z = depth[pixels[:, 1], pixels[:, 0]]
        z = np.where(np.isfinite(z), z, np.median(depth[np.isfinite(depth)]))
        found = camera.unproject(pixels + 0.5, z).double().numpy()
        if kind == "box":
            low, high = np.percentile(found, SEEN_PERCENT, axis=0)
            margin = MARGIN * (high - low).max()
            return Box.between(*(low - margin).tolist(), *(high + margin).tolist())
        low, high = self.subject.source.run(lambda model: model.gaussians.means.aminmax(dim=0))
        return Box.around([found[:, :2].tolist()], low[2].item(), high[2].item())

    def _places(
        self, kind: MarkKind, points: Sequence[tuple[float, float]]
    ) -> tuple[Pane, list[PanePoint]]:
        """What is drawn in the latest picture, and in which pane; ConfigError if not in one."""
        if kind == "box" and len(points) != 2:
            raise ConfigError("draw a box from one corner to the opposite one")
        found = [] if self.drawn is None else [self.drawn.place(x, y) for x, y in points]
        places = [place for place in found if place is not None]
        pane = places[0].pane if places else None
        if pane is None or len(places) < len(points) or any(p.pane is not pane for p in places):
            raise ConfigError("draw it within one picture")
        return pane, places

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
            assert self.view is not None
            camera, compared_with = pane.own_camera, self.view.camera
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
        return self._photo_images(modality, pane.photo, self.subject.temperature)

    def _titled(self, pane: Pane) -> Pane:
        """The pane; where surfaces elsewhere are corrected, the title of a model beside a thermal
        photo states that it is not."""
        corrects = self.subject.board is not None and self.subject.board.regions
        if not corrects or pane.photo is None or pane.kind == "photo" or pane.scaled != THERMAL:
            return pane
        return replace(pane, title=f"{pane.title}, emissivity of the photo")

    def _regions(self, pane: Pane) -> Regions | None:
        """Surfaces with an emissivity of their own; None beside photos, which have none."""
        board = self.subject.board
        return None if board is None or pane.photo is not None else board.regions

    def click(self, x: float, y: float) -> PointReading | None:
        """Read the point at a place of the latest picture, x and y from 0 to 1; None if empty."""
        self.point = None
        drawn = self.drawn
        if drawn is None or (place := drawn.place(x, y)) is None:
            return None
        pane, subject = place.pane, self.subject
        reading = subject.source.run(
            lambda model: read_point(
                model, pane.own_camera, place.u, place.v, subject, self._regions(pane)
            )
        )
        if reading is not None:
            photo_value = None
            if pane.photo is not None and pane.scaled is not None:
                value = float(place.pixel_of(self._photo(pane).images[pane.scaled]))
                photo_value = value if np.isfinite(value) else None
            if THERMAL in reading.values:
                here = reading.values[THERMAL]
                depth = drawn.images[drawn.panes.index(pane)].depth
                here = replace(here, value=self._of_place(place, depth, here.value))
                reading = replace(reading, values={**reading.values, THERMAL: here})
            self.point = PointReading(reading, self._first_readable(pane), photo_value)
        return self.point

    def hover(self, x: float, y: float) -> str:
        """What the latest picture shows at a place (x to the right, y down, 0 to 1), as text; empty
        where it shows no value."""
        drawn = self.drawn
        if drawn is None or (place := drawn.place(x, y)) is None:
            return ""
        pane, shown = place.pane, drawn.images[drawn.panes.index(place.pane)]
        modality = self._first_readable(pane)
        values = None if modality is None else shown.images.get(modality)
        if modality is None or values is None:
            return ""
        value = float(place.pixel_of(values))
        if not place.pixel_of(shown.solid) or not np.isfinite(value):
            return "no surface"
        if pane.kind not in ("uncertainty", "difference"):
            if modality == THERMAL:
                value = self._of_place(place, shown.depth, value, at_once=True)
            return self.subject.format_value(modality, value)
        if pane.kind == "uncertainty":
            return f"± {self.subject.format_difference(modality, value)}"
        return self.subject.format_difference(modality, value, sign=True)

    def _of_place(
        self,
        place: PanePoint,
        depth: Float[np.ndarray, "h w"] | None,
        shown: float,
        at_once: bool = False,
    ) -> float:
        """What a spot at a place of a picture with these depths would read; what the picture has
        ``shown`` where that is not known, and beside the photo that it is compared with."""
        board = self.subject.board
        if board is None or depth is None or place.pane.photo is not None:
            return shown
        camera, pixel = place.pane.camera.resized(*depth.shape[::-1]), place.pixel_in(depth)
        found = board.temperature(camera, depth, pixel, at_once)
        return found if np.isfinite(found) else shown

    def _first_readable(self, pane: Pane) -> Modality | None:
        """The modality whose value is named first in a pane."""
        modalities = (*reversed(pane.modalities), *self.subject.readable)
        return next((each for each in modalities if each.channels == 1), None)

    def add_keyframe(self) -> None:
        """Add the current camera to the path. ConfigError if no picture has been drawn yet."""
        if self.drawn is None:
            raise ConfigError("wait for the first picture, then add a keyframe")
        self.keyframes = (*self.keyframes, self.drawn.camera)

    def annotated_pictures(self, cameras: Sequence[Camera]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Pictures of a path with their marks, by the current settings and scales throughout."""
        self.point = None
        settings, scales, labels = self.settings, self._scales, self.labels()
        for camera in cameras:
            drawn = self._draw(camera, settings, scales)
            scales = drawn.scales
            yield annotate(drawn, labels)


def nearest_view(
    views: Sequence[View], camera: Camera, extent: float, preferred: int | None = None
) -> int:
    """Index of the captured view whose position and direction are closest to a camera's, a way of
    the scene's ``extent`` weighing as much as a right angle; ties go to ``preferred``."""
    costs = []
    for index, view in enumerate(views):
        other = view.camera
        way = (other.position - camera.position).norm().item() / extent
        turn = 1 - (other.forward @ camera.forward).item()
        costs.append(way + turn - (1e-3 if index == preferred else 0.0))
    return int(np.argmin(costs))
