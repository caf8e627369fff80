"""The marks of a run, from Python."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from mrgs.errors import ConfigError, SceneError
from mrgs.marks.mark import Mark, MarkKind, Marks, Place, places_of
from mrgs.marks.measure import MarkMeter, MarkReading
from mrgs.marks.photo_readings import PhotoReadings
from mrgs.marks.regions import Regions
from mrgs.marks.stereo import PhotoStereo
from mrgs.marks.store import CameraSpread, MarkStore
from mrgs.marks.surface import SAME_SURFACE, see, steady_depth
from mrgs.marks.uncertainty import UncertaintyMeter
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Camera, Rendering, Scene, WorldFrame
from mrgs.scene.arrays import Array, as_tensor
from mrgs.scene.camera import MIN_DEPTH
from mrgs.survey import SURVEY_FILE, read_survey
from mrgs.system.torch_modes import own_modes
from mrgs.training.checkpoint import shift_temperatures

SPOT_PHOTO_PX = 3.0
"""Diameter of a spot in pixels of the nearest thermal photo, as on a camera's spot meter."""

DISC_PX = 11
"""Pixels across the disc that are looked at under a cursor, at most."""

SPOT_SHARE = 0.01
"""Diameter of a spot as a share of its distance from the eye, where no photo is known."""


class RunMarks:
    """The marks of a run: added, changed, measured, and saved at once in its ``marks.json``.
    SceneError if the run is old and its scene is not there. ``scene`` is the run's, if read."""

    def __init__(self, run: Run, scene: Scene | None = None) -> None:
        self.run = run
        self.store = MarkStore(run.folder.path, CameraSpread.of_run(run))
        if scene is None:
            with suppress(SceneError):
                scene = run.load_scene()
        self.scene = scene
        uncertainty = None
        if scene is not None:
            survey = read_survey(run.folder.path / SURVEY_FILE)
            views, respond = scene.survey_views(THERMAL), run.camera_response
            readings = PhotoReadings(run.render, respond, views, run.temperature)
            uncertainty = UncertaintyMeter.of(readings, scene, run.temperature, survey)
        self.meter = MarkMeter.of(run.render, run.temperature, scene, uncertainty)
        self._picker = MarkPicker(self.meter, self.scene)

    @property
    def marks(self) -> Marks:
        """The marks as they are on the disk. RunError if the file cannot be read, or has the marks
        of another model."""
        return self.store.read()

    @property
    def world(self) -> WorldFrame:
        """The frame of the marks' coordinates."""
        return WorldFrame() if self.scene is None else self.scene.world

    def spot(self, camera: Camera, pixel: Sequence[float], name: str = "", **more: Any) -> Mark:
        """Add a spot on the surface at a pixel (x, y) of a camera's image; returns it.

        Args:
            pixel: x to the right and y down, pixels.
            name: S1, S2 ... if empty.
            more: other fields of ``Mark``, such as ``radius`` or ``note``.

        Raises:
            ConfigError: no surface is seen there, the name is taken, or a value cannot be.
            RunError: the file cannot be written, or has the marks of another model.
        """
        return self.add("spot", camera, [pixel], name, **more)

    def line(
        self, camera: Camera, pixels: Sequence[Sequence[float]], name: str = "", **more: Any
    ) -> Mark:
        """Add a line through the surface at two or more pixels; see ``spot``."""
        return self.add("line", camera, pixels, name, **more)

    def box(
        self, camera: Camera, corner: Sequence[float], opposite: Sequence[float],
        name: str = "", **more: Any,
    ) -> Mark:  # fmt: skip
        """Add the surface within a rectangle of an image, between two corners; see ``spot``."""
        return self.add("box", camera, [corner, opposite], name, **more)

    def polygon(
        self, camera: Camera, pixels: Sequence[Sequence[float]], name: str = "", **more: Any
    ) -> Mark:
        """Add the surface within three or more pixels; see ``spot``."""
        return self.add("polygon", camera, pixels, name, **more)

    def add(
        self, kind: MarkKind, camera: Camera, pixels: Sequence[Sequence[float]],
        name: str = "", **more: Any,
    ) -> Mark:  # fmt: skip
        """Add a mark of any kind through pixels of a camera's image; see ``spot``."""
        fields = {**self._picker.pick(kind, camera, pixels), **more}
        return self.store.edit(lambda marks: marks.adding(kind, name, **fields)).marks[-1]

    def change(self, name: str, /, **changes: Any) -> Mark:
        """Change fields of a mark; returns it. See ``Mark`` for the fields. ConfigError if there is
        no such mark, or a value cannot be; RunError if the file cannot be written."""
        return self.store.edit(lambda marks: marks.changing(name, **changes)).named(
            changes.get("name", name)
        )

    def remove(self, name: str) -> None:
        """Delete a mark; errors as for ``change``."""
        self.store.edit(lambda marks: marks.without(name))

    def accept(self, name: str, /, **changes: Any) -> Mark:
        """Make a proposal of the report a mark, with other fields where they are given; returns it.
        Errors as for ``change``."""
        return self.store.edit(lambda marks: marks.accepting(name, **changes)).marks[-1]

    def drop(self, name: str) -> None:
        """Drop a proposal of the report for good; errors as for ``accept``."""
        self.store.edit(lambda marks: marks.dropping(name))

    def refer_to(self, name: str) -> None:
        """Let ΔT of all marks refer to one of them, to none if empty; errors as for ``change``."""
        self.store.edit(lambda marks: replace(marks, reference=name))

    def calibrate(self, name: str, celsius: float) -> None:
        """Let ΔT refer to a mark whose true mean is known, °C, and shift all temperatures of the
        run by the constant that the photos leave open; open the run again to see them. ConfigError
        if there is no such mark, no photo sees it, or the scene has no °C; RunError if the run is
        being trained, or a file cannot be written."""
        marks = self.marks
        reading = self.meter.read(marks.named(name), self.meter.regions(marks))
        if reading.problem or self.run.temperature is None:
            problem = reading.problem or "the scene has no °C"
            raise ConfigError(
                f"{name} cannot be a reference temperature: {problem}; choose a mark that photos "
                f"in °C see",
                options=("reference",),
            )
        both = np.array([celsius, reading.mean])
        if reading.surface is not None:
            both = self.meter.capture.as_photos(both, reading.surface)
        shift_temperatures(self.run.folder, float(both[0] - both[1]))
        self.refer_to(name)

    def undo(self) -> None:
        """Undo the last change; errors as for ``change``, also if there is nothing to undo."""
        self.store.undo()

    def assumptions_of(self, reading: MarkReading) -> tuple[str, ...]:
        """Assumptions of a corrected emissivity and of the ±, one sentence each."""
        corrected = self.meter.capture.notes if reading.surface is not None else ()
        known = self.meter.uncertainty
        around = known.notes if known is not None and reading.uncertainty is not None else ()
        return (*corrected, *around)

    def measure(self) -> list[MarkReading]:
        """Measure all marks in the model as it is now."""
        return self.meter.measure(self.marks)

    def render(self, camera: Camera) -> Rendering:
        """What ``Run.render`` shows, with the temperatures of areas that have an emissivity of
        their own corrected."""
        return self._regions.applied_to(self.run.render(camera), camera)

    def temperature_at(self, points: Array) -> Float[torch.Tensor, " n"]:
        """``Run.temperature_at``, corrected in the same areas."""
        celsius = self.run.temperature_at(points).numpy()
        positions = as_tensor(points, torch.float32, (None, 3), "points").numpy()
        return torch.from_numpy(self._regions.corrected_at(positions, celsius))

    def uncertainty_at(self, points: Array) -> Float[torch.Tensor, " n"]:
        """The ± of ``temperature_at``, K, [N]: the truth lies within it in 95 of 100 cases. NaN
        where no photo looked, and everywhere if the scene is not there."""
        positions = as_tensor(points, torch.float32, (None, 3), "points").numpy()
        if (meter := self.meter.uncertainty) is None:
            return torch.full((len(positions),), torch.nan)
        celsius = self.run.temperature_at(points).numpy()
        return torch.from_numpy(meter.of_points(positions, celsius, self._regions))

    @property
    def _regions(self) -> Regions:
        return self.meter.regions(self.marks)

    def measure_proposals(self) -> list[MarkReading]:
        """Measure the proposals of the report, in the same way."""
        return self.meter.measure(Marks(self.marks.proposals), self._regions)


def open_marks(run: Run, scene: Scene | None = None) -> RunMarks:
    """The marks of a run; see ``RunMarks``."""
    return RunMarks(run, scene)


class MarkPicker:
    """Finds the places on the surface for a mark that is drawn in an image: at depths on which the
    photos agree, or without ``by_photos`` at those of the model."""

    def __init__(self, meter: MarkMeter, scene: Scene | None, by_photos: bool = True) -> None:
        self.meter, self._scene = meter, scene
        views = scene.survey_views(THERMAL) if scene else ()
        self._stereo = PhotoStereo(meter.survey, views) if by_photos and views else None

    def pick(
        self, kind: MarkKind, camera: Camera, pixels: Sequence[Sequence[float]]
    ) -> dict[str, Any]:
        """``points``, ``eye`` and ``radius`` of a mark through pixels (x, y) of a camera's image; a
        box may have two opposite corners. ConfigError if a pixel is outside the image, or shows no
        surface; SceneError if a photo cannot be read."""
        if kind == "box" and len(pixels) == 2:
            (x0, y0), (x1, y1) = pixels
            pixels = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        surface, places = see(self.meter.render, camera), []
        for x, y in pixels:
            if not (0 <= x < camera.width and 0 <= y < camera.height):
                size = f"{camera.width} × {camera.height}"
                raise ConfigError(f"pixel {x:g}, {y:g} lies outside the image of {size}")
            depth = steady_depth(surface, x, y)
            if not np.isfinite(depth):
                raise ConfigError(f"no surface at pixel {x:g}, {y:g}: choose a place on the model")
            if self._stereo is not None:
                depth = self._stereo.depth(camera, x, y, depth)
            places.append(camera.unproject([x, y], depth).tolist())
        points, eye = places_of(places), tuple(camera.position.tolist())
        radius = spot_radius(points[0], camera, self._scene) if kind == "spot" else 0.0
        return {"points": points, "eye": eye, "radius": radius}

    def temperature(
        self,
        camera: Camera,
        depth: Float[np.ndarray, "h w"],
        pixel: tuple[int, int],
        regions: Regions,
        at_once: bool = False,
    ) -> float:
        """What a spot at a pixel (column, row) of a picture would read, from the picture's z-depths
        alone; NaN where no photo sees the place, the model changes, or, ``at_once``, what the
        photos' cameras see there has not been rendered yet."""
        z = depth[pixel[1], pixel[0]]
        if not np.isfinite(z):
            return np.nan
        place = camera.unproject(np.add(pixel, 0.5), z)
        radius = spot_radius(tuple(place.tolist()), camera, self._scene)
        steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, DISC_PX)] * 2), axis=-1)
        disc = radius * camera.K[0, 0].item() / z * steps[np.hypot(*steps.T) <= 1]
        pixels = np.unique(np.rint(np.add(pixel, disc)).astype(int), axis=0)
        pixels = pixels[camera.contains(pixels + 0.5).numpy()]
        around = depth[pixels[:, 1], pixels[:, 0]]
        same = np.abs(around - z) < SAME_SURFACE * z
        places = camera.unproject(pixels[same] + 0.5, around[same]).double().numpy()
        if at_once and not self.meter.survey.made_near(places.astype(np.float32)):
            return np.nan
        unknown = np.full(len(places), np.nan)
        found, _ = self.meter.temperatures(places, unknown, regions, camera.position.numpy())
        known = found[np.isfinite(found)]
        return float(known.mean()) if known.size else np.nan


@own_modes()
def spot_radius(place: Place, camera: Camera, scene: Scene | None) -> float:
    """Radius of a spot as wide as three pixels of the nearest thermal photo, scene units."""
    point = torch.tensor(place, dtype=torch.float64)
    if photos := thermal_cameras(scene):  # at once: this follows the cursor
        viewmats = torch.stack([photo.viewmat for photo in photos])
        Ks = torch.stack([photo.K for photo in photos])
        in_camera = viewmats[:, :3, :3] @ point + viewmats[:, :3, 3]
        depths = in_camera[:, 2]
        pixels = (Ks @ in_camera[:, :, None])[:, :2, 0] / depths[:, None]
        sizes = torch.tensor([(photo.width, photo.height) for photo in photos])
        shows = (depths >= MIN_DEPTH) & ((pixels >= 0) & (pixels < sizes)).all(dim=1)
        if shows.any():
            return 0.5 * SPOT_PHOTO_PX * (depths / Ks[:, 0, 0])[shows].min().item()
    return 0.5 * SPOT_SHARE * (point - camera.position).norm().item()


def thermal_cameras(scene: Scene | None) -> list[Camera]:
    """The cameras of a scene's thermal training photos."""
    return [] if scene is None else [photo.camera for photo in scene.train_photos(THERMAL)]
