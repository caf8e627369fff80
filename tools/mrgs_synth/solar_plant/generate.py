"""Survey a solar plant, and write down the truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numba
import numpy as np
import torch
from jaxtyping import Float, UInt8

from mrgs.errors import ConfigError
from mrgs.scene import Camera, TemperatureRange, WorldFrame
from mrgs_synth.cameras import WORLD, Frame
from mrgs_synth.sensor import ThermalSensor, quantise, rounded_range
from mrgs_synth.solar_plant.cast import (
    RAYS_PER_SIDE,
    Photo,
    Surfaces,
    photograph,
    seen_from,
    surfaces_of,
    warmest_and_coldest,
)
from mrgs_synth.solar_plant.flight import (
    ORIGIN,
    Flight,
    footprint_m,
    gps_exif,
    survey,
)
from mrgs_synth.solar_plant.layout import Plant, drawn_plant
from mrgs_synth.write import SceneFolder

SENSOR = ThermalSensor(point_spread_px=1.1, netd_c=0.05, column_noise_c=0.03)
IMAGE_BITS: Literal[16] = 16
POINTS_PER_PHOTO = 150
POINT_NOISE_M = 0.02
OTHERS = 8
"""Cameras, the nearest ones, of which one more must see a sparse point."""

DEFECTS = "truth/defects.json"


@dataclass(frozen=True)
class PlantOptions:
    """The size of a plant, and how it is surveyed.

    Attributes:
        rows: of tables, 6 m apart.
        modules: along each row, 1.05 m wide; two stand above each other.
        overlap: of neighbouring photos and of neighbouring lines of the flight, a share of the
            photo.
        gps_noise_m: standard deviation of each coordinate of the positions in the photos' EXIF.
        eval_views: between the training views.
        width: of the images in pixels, even; they always show 16 m.
        height: of the images in pixels, even.
        seed: of everything.

    Raises:
        ConfigError: a value that is not allowed.
    """

    rows: int = 4
    modules: int = 20
    overlap: float = 0.75
    gps_noise_m: float = 0.5
    eval_views: int = 8
    width: int = 320
    height: int = 240
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rows < 1 or self.modules < 1:
            raise ConfigError("a plant needs a row and a module", options=("rows", "modules"))
        if not 0.0 <= self.overlap <= 0.95:
            raise ConfigError(
                f"the overlap is a share of a photo, 0 to 0.95, not {self.overlap:g}",
                options=("overlap",),
            )
        if not 0.0 <= self.gps_noise_m < np.inf:
            raise ConfigError("the noise of GPS is 0 m or more", options=("gps_noise",))
        if self.eval_views < 0 or min(self.size) < 16 or any(side % 2 for side in self.size):
            raise ConfigError(
                "choose even sizes of 16 pixels or more, and 0 or more evaluation views"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images."""
        return self.width, self.height

    def plant(self) -> Plant:
        """The plant of these options."""
        border = 1.5 * max(footprint_m(*self.size))
        rng = np.random.default_rng([self.seed, 0])
        return drawn_plant(self.rows, self.modules, border, rng)

    def flight(self, plant: Plant) -> Flight:
        """The flight over it."""
        return survey(
            plant.low, plant.high, self.overlap, self.size, self.eval_views, self.gps_noise_m,
            np.random.default_rng([self.seed, 3]),
        )  # fmt: skip


def synthesize_plant(
    output: Path,
    options: PlantOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Generate the survey of a solar plant with exact truth, in ThermoScenes' layout; the same
    options give the same files.

    The scene is in metres, with axes to the east, north and up of a place on Earth. Each RGB photo
    has its position by GPS in its EXIF. ``output/truth/defects.json`` lists the hot cells; the
    evaluation views have exact temperatures and depths as in ``synthesize``.

    Args:
        output: the new scene folder.
        options: size and survey.
        progress: called after each view with the number of views done and of all views.

    Returns:
        the number of training views.

    Raises:
        ConfigError: ``output`` holds a scene already, or cannot be written.
    """
    options = options or PlantOptions()
    plant = options.plant()
    return photograph_plant(output, plant, options, progress=progress)


def photograph_plant(
    output: Path,
    plant: Plant,
    options: PlantOptions,
    *,
    frame: Frame = WORLD,
    warmer_c: float = 0.0,
    every_truth: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Write the survey of a plant, see ``synthesize_plant``, in the coordinates of ``frame``, all
    of it warmer by ``warmer_c``, and with ``every_truth`` also the training views' exact truth."""
    flight = options.flight(plant)
    target = SceneFolder.create(output)
    _photograph(
        target, surfaces_of(plant), plant, flight, options.seed, frame, warmer_c, every_truth,
        progress,
    )  # fmt: skip
    _write_truth(target, plant, options)
    world = WorldFrame(
        metric=True, north=True, origin=ORIGIN, residual_m=round(flight.gps_residual_m, 3)
    )
    target.transforms(
        {name: frame.camera(each) for name, each in flight.cameras.items()}, world=world
    )
    return len(_train_cameras(flight))


def _train_cameras(flight: Flight) -> list[Camera]:
    return [camera for name, camera in flight.cameras.items() if "_train_" in name]


def _photograph(
    target: SceneFolder,
    surfaces: Surfaces,
    plant: Plant,
    flight: Flight,
    seed: int,
    frame: Frame,
    warmer_c: float,
    every_truth: bool,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Write the photos and the sparse points; several photos at a time."""
    coldest, hottest = warmest_and_coldest(plant)
    temperature = rounded_range(coldest + warmer_c, hottest + warmer_c)
    train = _train_cameras(flight)
    names = list(flight.cameras)

    def take(number: int) -> tuple[np.ndarray, np.ndarray]:
        name = names[number]
        camera = flight.cameras[name]
        photo = photograph(surfaces, camera)
        photo = photo._replace(exact_c=photo.exact_c + warmer_c)
        exif = gps_exif(flight.gps_m[number], number)
        _write(target, name, photo, temperature, exif, number, seed)
        if every_truth or "_eval_" in name:
            target.truth(name, photo.exact_c, photo.depth_m)
        if "_train_" not in name:
            return np.empty((0, 3)), np.empty((0, 3), np.uint8)
        return _points(surfaces, train, number, photo, np.random.default_rng([seed, 4, number]))

    found = []
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        for done, points in enumerate(pool.map(take, range(len(names))), start=1):
            found.append(points)
            if progress is not None:
                progress(done, len(names))
    target.temperature_bounds(temperature)
    positions, colors = (np.concatenate(parts) for parts in zip(*found, strict=True))
    target.points(frame.points(positions), colors)


def _write(
    target: SceneFolder,
    name: str,
    photo: Photo,
    temperature: TemperatureRange,
    exif: bytes,
    number: int,
    seed: int,
) -> None:
    target.rgb(name, photo.rgb, exif)
    celsius = SENSOR.photograph(photo.exact_c, number, seed)
    target.thermal(name, quantise(celsius, temperature, IMAGE_BITS))


def _points(
    surfaces: Surfaces,
    train: list[Camera],
    number: int,
    photo: Photo,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Points of a photo that another one shows too, with the noise of structure from motion."""
    camera = train[number]
    chosen = rng.choice(
        photo.depth_m.size, min(POINTS_PER_PHOTO, photo.depth_m.size), replace=False
    )
    row, column = np.unravel_index(chosen, photo.depth_m.shape)
    pixels = torch.from_numpy(np.stack([column, row], axis=1) + 0.5)
    points = camera.unproject(pixels, torch.from_numpy(photo.depth_m[row, column]))
    away = torch.stack([(other.position - camera.position).norm() for other in train])
    seen = np.zeros(len(points), bool)
    for other in away.argsort()[1 : OTHERS + 1].tolist():
        inside = train[other].contains(train[other].project(points)[0]).numpy()
        seen |= inside & seen_from(surfaces, train[other].position.numpy(), points.numpy())
    kept = points.numpy()[seen]
    return kept + rng.normal(0.0, POINT_NOISE_M, kept.shape), photo.rgb[row, column][seen]


def _write_truth(target: SceneFolder, plant: Plant, options: PlantOptions) -> None:
    listed = {"defects": [defect.to_json() for defect in plant.defects]}
    text = json.dumps(listed, indent=1) + "\n"
    (target.path / DEFECTS).write_text(text, encoding="utf-8")
    target.parameters(
        {
            "scene": "solar-plant",
            **asdict(options),
            "thermal_sensor": asdict(SENSOR)
            | {"detector_pixels_per_image_pixel": 0.5, "image_bits": IMAGE_BITS},
            "truth": {"rays_per_pixel": RAYS_PER_SIDE**2, "emissivity": 1.0},
            "sparse_point_noise_m": POINT_NOISE_M,
        }
    )
