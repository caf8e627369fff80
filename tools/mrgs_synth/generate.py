"""Generate a scene: photograph a stage in colour and in the infrared, and write down the truth."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from mrgs.errors import ConfigError
from mrgs.scene import Camera
from mrgs_synth.bands import BANDS, in_band
from mrgs_synth.cameras import WORLD, Frame, gaps
from mrgs_synth.electronics import electronics
from mrgs_synth.facade import facade
from mrgs_synth.hits import Hits, Triangles, first_hits
from mrgs_synth.imager import CameraName, ThermalImager, named_imager
from mrgs_synth.points import sparse_points
from mrgs_synth.radiometry import pixel_readings, ray_readings
from mrgs_synth.random_scenes import KINDS, drawn_kind, drawn_stage
from mrgs_synth.sensor import ThermalSensor, quantise, rounded_range
from mrgs_synth.series import Series
from mrgs_synth.stage import Stage
from mrgs_synth.tabletop import tabletop
from mrgs_synth.tracer import PathTracer
from mrgs_synth.write import DEPTH_STEP_M, TEMPERATURE_STEP_C, SceneFolder

SceneKind = Literal[
    "tabletop", "facade", "electronics", "room", "house", "circuit", "roof", "machine", "random"
]
STAGES: dict[str, Callable[[int], Stage]] = {
    "tabletop": tabletop,
    "facade": facade,
    "electronics": electronics,
    **{kind: partial(drawn_stage, kind) for kind in KINDS},
}

RAYS_PER_SIDE = 4
METERED_VIEWS = 6
POINTS = 7000
IMAGER_BITS: Literal[16] = 16


@dataclass(frozen=True, eq=False)
class Shot:
    """What one camera sees: the photo, the exact temperatures in °C, the first hits of the pixel
    centres, and the radiance on the detector of a ``ThermalImager``."""

    photo: UInt8[np.ndarray, "h w 3"]
    exact_c: Float[np.ndarray, "h w"]
    hits: Hits
    radiance: Float[np.ndarray, "h2 w2"] | None = None


def synthesize(
    output: Path,
    *,
    scene: SceneKind = "tabletop",
    width: int = 320,
    height: int = 240,
    train_views: int = 40,
    eval_views: int = 8,
    samples: int = 64,
    seed: int = 0,
    truth: Literal["eval", "all"] = "eval",
    bands: Sequence[str] = (),
    camera: CameraName | ThermalImager = "gaussian",
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Generate a scene with exact truth, in ThermoScenes' layout. The same arguments and Mitsuba
    give the same files.

    The exact temperature of a pixel is what an ideal camera reads that is set to an emissivity of
    1 (``radiometry``): the temperature of the mean radiance of 16 rays, which is the surfaces' own
    where they are black bodies, as in the scenes that are not drawn; in the others they also
    reflect heat. The exact depth is the z-depth at the pixel's centre. Both are written as
    ``output/truth/{temperature,depth}/NAME.tiff``; how the scene was made, as
    ``output/truth/synth.json``.

    Args:
        output: the new scene folder.
        scene: what to generate; "random" is a kind of ``random_scenes`` that the seed chooses.
        width: image width in pixels, even.
        height: image height in pixels, even.
        train_views: number of training views, 2 or more.
        eval_views: number of evaluation views, which lie between the training views.
        samples: paths per pixel of the colour photos; the time is proportional to it.
        seed: of the textures, the camera jitter and all noise; in scenes that are drawn, of
            everything.
        truth: whether the truth is written for the evaluation views or for all.
        bands: further modalities, of ``BANDS``: "nir" is near infrared. The other files stay the
            same, but for ``transforms.json``.
        camera: the thermal camera; by default the stage's own, with a Gaussian blur. With another
            one, ``output/truth/camera`` says what it did to each photo.
        progress: called after each view with the number of views done and of all views.

    Raises:
        ConfigError: an argument is not allowed, ``output`` holds a scene already, or Mitsuba is not
            installed.
    """
    imager = named_imager(camera)
    _check(width, height, train_views, eval_views, samples, bands)
    if imager is not None:
        _check_size(width, height, imager)
    kind = drawn_kind(seed) if scene == "random" else scene
    stage = STAGES[kind](seed)
    cameras = stage_cameras(stage, width, height, train_views, eval_views, seed)
    parameters = {"scene": scene, **({"kind": kind} if kind != scene else {})}
    photograph_stage(
        output, stage, cameras, samples=samples, seed=seed, every_truth=truth == "all",
        bands=bands, camera=camera, progress=progress, parameters=parameters,
    )  # fmt: skip


def photograph_stage(
    output: Path,
    stage: Stage,
    cameras: dict[str, Camera],
    *,
    samples: int,
    seed: int,
    every_truth: bool,
    bands: Sequence[str] = (),
    camera: CameraName | ThermalImager = "gaussian",
    progress: Callable[[int, int], None] | None = None,
    parameters: Mapping[str, Any] = MappingProxyType({}),
    frame: Frame = WORLD,
) -> None:
    """Write a scene of a stage that named cameras photograph, see ``synthesize``; ``parameters``
    are kept beside the seed, and the scene is in the coordinates of ``frame``. ConfigError if
    ``output`` holds a scene already, or Mitsuba is not installed."""
    imager = named_imager(camera)
    tracer = _tracer(stage, cameras, seed)
    target = SceneFolder.create(output)
    series = None
    if imager is not None:
        name = camera if isinstance(camera, str) else "custom"
        series = _series(name, imager, stage, cameras, seed)
    shots = _photograph(stage, tracer, cameras, samples, seed, progress, series)
    _write_photos(target, shots, every_truth, frame.scale)
    if series is None:
        _write_thermal(target, stage.sensor, shots, seed)
    else:
        _write_series(target, series, shots)
    for band in bands:
        _write_band(target, stage, band, cameras, samples, seed)
    _write_points(target, stage, cameras, shots, seed, frame)
    target.parameters(
        {**parameters, "seed": seed, "samples": samples, **_stage_parameters(stage, series)}
    )
    target.transforms(
        {name: frame.camera(each) for name, each in cameras.items()},
        [BANDS[band].modality for band in bands],
        world=frame.world,
        records={} if series is None else series.records(),
    )


def _write_points(
    target: SceneFolder,
    stage: Stage,
    cameras: dict[str, Camera],
    shots: dict[str, Shot],
    seed: int,
    frame: Frame,
) -> None:
    train = [name for name in cameras if "_train_" in name]
    positions, colors = sparse_points(
        [cameras[name] for name in train],
        [shots[name].hits for name in train],
        [shots[name].photo for name in train],
        POINTS,
        stage.point_noise_m,
        np.random.default_rng([seed, 4]),
    )
    target.points(frame.points(positions), colors)


def _check(
    width: int,
    height: int,
    train_views: int,
    eval_views: int,
    samples: int,
    bands: Sequence[str],
) -> None:
    if width < 16 or height < 16 or width % 2 or height % 2:
        raise ConfigError(
            f"images of {width}×{height} cannot be generated: choose even sizes of 16 pixels or "
            f"more"
        )
    if train_views < 2 or eval_views < 0 or samples < 1:
        raise ConfigError(
            "choose 2 or more training views, 0 or more evaluation views, and 1 or more samples"
        )
    if unknown := set(bands) - set(BANDS):
        raise ConfigError(
            f"unknown bands {', '.join(sorted(unknown))}: choose of {', '.join(BANDS)}"
        )


def _check_size(width: int, height: int, imager: ThermalImager) -> None:
    if width % imager.enlargement or height % imager.enlargement:
        raise ConfigError(
            f"images of {width}×{height} cannot be enlarged from a detector with 1/"
            f"{imager.enlargement} of the width and height: choose multiples of "
            f"{imager.enlargement}"
        )


def _tracer(stage: Stage, cameras: dict[str, Camera], seed: int) -> PathTracer:
    with tempfile.TemporaryDirectory() as folder:
        tracer = PathTracer(stage, Path(folder))
    if stage.exposure is None:
        tracer.meter(list(cameras.values())[:: max(len(cameras) // METERED_VIEWS, 1)], seed)
    return tracer


def stage_cameras(
    stage: Stage, width: int, height: int, train_views: int, eval_views: int, seed: int
) -> dict[str, Camera]:
    """The cameras by the name of their frame."""
    rng = np.random.default_rng([seed, 3])
    train = stage.cameras.train(train_views, width, height, rng)
    held_out = stage.cameras.between(eval_views, train_views, width, height, rng)
    named = {f"frame_train_{number:05d}": camera for number, camera in enumerate(train, start=1)}
    return named | {
        f"frame_eval_{number:05d}": camera for number, camera in enumerate(held_out, start=1)
    }


def _series(
    camera: str, imager: ThermalImager, stage: Stage, cameras: dict[str, Camera], seed: int
) -> Series:
    """The photos in the order of the walk, on which evaluation views are taken between the training
    views, focused as the camera does."""
    train = [name for name in cameras if "_train_" in name]
    held_out = [name for name in cameras if "_train_" not in name]
    place = {name: float(number) for number, name in enumerate(train)}
    after = gaps(len(held_out), len(train))
    place |= {name: gap - 0.5 for name, gap in zip(held_out, after, strict=True)}
    names = sorted(place, key=place.__getitem__)
    focus_m = imager.focus_m
    if focus_m is None:
        depth_m = first_hits(cameras[names[0]], Triangles.of(stage.solids)).depth_m
        focus_m = float(depth_m[depth_m.shape[0] // 2, depth_m.shape[1] // 2])
    return Series.of(camera, imager, focus_m, names, seed)


def _photo_seeds(cameras: dict[str, Camera], seed: int) -> dict[str, int]:
    """The path tracer's seed of each photo."""
    return {name: seed * len(cameras) + number for number, name in enumerate(cameras, start=1)}


def _photograph(
    stage: Stage,
    tracer: PathTracer,
    cameras: dict[str, Camera],
    samples: int,
    seed: int,
    progress: Callable[[int, int], None] | None,
    series: Series | None,
) -> dict[str, Shot]:
    triangles = Triangles.of(stage.solids)
    shots, seeds = {}, _photo_seeds(cameras, seed)
    for number, (name, camera) in enumerate(cameras.items(), start=1):
        rays_c, rays_depth_m = ray_readings(camera, stage, triangles, RAYS_PER_SIDE)
        exposed, radiance = 1.0, None
        if series is not None:
            exposed = 2.0 ** series.moments[name].exposure_ev
            focal = RAYS_PER_SIDE * float(camera.K[0, 0])
            radiance = series.imager.exposed(
                rays_c, rays_depth_m, series.focus_m, focal, RAYS_PER_SIDE
            )
        shots[name] = Shot(
            photo=tracer.photograph(camera, samples, seeds[name], exposed),
            exact_c=pixel_readings(rays_c, RAYS_PER_SIDE),
            hits=first_hits(camera, triangles),
            radiance=radiance,
        )
        if progress is not None:
            progress(number, len(cameras))
    return shots


def _write_photos(
    target: SceneFolder, shots: dict[str, Shot], every_truth: bool, scale: float
) -> None:
    for name, shot in shots.items():
        target.rgb(name, shot.photo)
        if every_truth or "_eval_" in name:
            target.truth(name, shot.exact_c, scale * shot.hits.depth_m)


def _write_thermal(
    target: SceneFolder, sensor: ThermalSensor, shots: dict[str, Shot], seed: int
) -> None:
    coldest = min(float(shot.exact_c.min()) for shot in shots.values())
    hottest = max(float(shot.exact_c.max()) for shot in shots.values())
    temperature = rounded_range(coldest, hottest)
    for frame, (name, shot) in enumerate(shots.items()):
        target.thermal(name, quantise(sensor.photograph(shot.exact_c, frame, seed), temperature))
    target.temperature_bounds(temperature)


def _write_series(target: SceneFolder, series: Series, shots: dict[str, Shot]) -> None:
    """Write the thermal photos of a ``ThermalImager`` with 16 bits, and what it did to them.

    Of the readings beyond all exact temperatures a thousandth is clipped in each photo, so that a
    hot pixel does not widen the range.
    """
    exact_c = np.stack([shot.exact_c for shot in shots.values()])
    radiances = {name: shot.radiance for name, shot in shots.items() if shot.radiance is not None}
    size = next(iter(radiances.values())).shape
    detector = series.detector((size[0], size[1]), float(np.median(exact_c)))
    celsius = {
        name: series.thermal_photo(name, detector, radiance, shots[name].photo)
        for name, radiance in radiances.items()
    }
    tails = np.array([np.quantile(image, [0.001, 0.999]) for image in celsius.values()])
    coldest = min(float(exact_c.min()), float(tails[:, 0].min()))
    temperature = rounded_range(coldest, max(float(exact_c.max()), float(tails[:, 1].max())))
    for name, image in celsius.items():
        target.thermal(name, quantise(image, temperature, IMAGER_BITS))
    target.temperature_bounds(temperature)
    maps_c = {"shading": detector.shading_c, "pattern": detector.pattern_c}
    target.camera(series.parameters(detector), maps_c)


def _write_band(
    target: SceneFolder,
    stage: Stage,
    band: str,
    cameras: dict[str, Camera],
    samples: int,
    seed: int,
) -> None:
    """Photograph the stage in another band of light, from the same cameras."""
    tracer = _tracer(in_band(stage, BANDS[band]), cameras, seed)
    seeds = _photo_seeds(cameras, seed)
    for name, camera in cameras.items():
        photo = tracer.photograph(camera, samples, seeds[name])
        target.band(BANDS[band].modality, name, photo[..., 0])


def _stage_parameters(stage: Stage, series: Series | None) -> dict[str, Any]:
    emissivities = [solid.material.emissivity for solid in stage.solids]
    lowest, highest = min(emissivities), max(emissivities)
    sensor = asdict(stage.sensor) | {"detector_pixels_per_image_pixel": 0.5, "image_bits": 8}
    if series is not None:
        sensor = {"camera": series.camera, "image_bits": IMAGER_BITS}
    return {
        "thermal_sensor": sensor,
        "truth": {
            "rays_per_pixel": RAYS_PER_SIDE**2,
            "temperature_step_c": TEMPERATURE_STEP_C,
            "depth_step_m": DEPTH_STEP_M,
            "emissivity": 1.0 if lowest == 1.0 else [round(lowest, 3), round(highest, 3)],
        },
        "sparse_point_noise_m": stage.point_noise_m,
    }
