"""A run's whole configuration: nested settings, and the methods and presets that fill them in."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from mrgs.errors import ConfigError
from mrgs.field import FieldConfig
from mrgs.field.spherical_harmonics import MAX_DEGREE
from mrgs.method.camera_model.image_model import ImageModelConfig
from mrgs.method.density import AdaptiveDensityControl, ConfiguredStrategy
from mrgs.method.losses.photometric import LossConfig
from mrgs.method.losses.radiation import RadiationConfig
from mrgs.method.optimizer import OptimizerConfig
from mrgs.rasterizer.contract import DILATION_PX2, LEAST_DILATION_PX2, Dilation
from mrgs.scene.capture import Capture
from mrgs.scene.radiometry import BandRadiance
from mrgs.system.strict_yaml import MOST_SEED, MOST_STEPS, read_yaml, require_within, whole_number
from mrgs.system.wording import shown

Preset = Literal["fast", "default", "paper"]
PRESETS: tuple[Preset, ...] = get_args(Preset)

DEFAULT_METHOD = "mrgs-plus"
"""Configured and trained where none is named."""

CPU_RATES = {
    "means": 9.6e-4,
    "means_final": 4.8e-6,
    "quats": 4e-3,
    "log_scales": 2e-2,
    "sh_dc": 1e-2,
    "sh_rest": 5e-4,
    "temperature_dc": 1e-2,
    "temperature_rest": 5e-4,
    "heads": 1.5e-3,
    "slowdown_from": 0.7,
    "slowdown_to": 0.05,
}
"""Learning rates for CPUs, whose schedules are too short for 3DGS's (docs/decisions, 040)."""

SMOOTHNESS = {
    "smooth_rgb": 0.0,
    "smooth_thermal": 0.0625,
    "smooth_depth": 0.0,
    "smooth_noise": 2e-3,
}
"""Weights of L_smooth's parts in the presets for CPUs: temperatures alone, more where the photos
are noisy or few are thermal (docs/decisions, 046 and 049)."""

PLUS_LOSS = {
    **SMOOTHNESS,
    "smooth_thermal": 0.0,
    "smooth_alike": 0.5,
    "smooth_noise": 4e-3,
    "huber_noise": 1.5,
    "full_contrast": 0.2,
    "opaque": 0.1,
    "distortion": 0.1,
}
"""The losses of ``mrgs-plus`` in all presets: temperatures are smooth where the colours are, and
noise counts by its squares (docs/decisions, 049)."""

PLUS_DILATION_PX2 = 0.1
"""Dilation of ``mrgs-plus``: about the variance of a square pixel, 1/12 px². With 0.3 a rendering
is blurrier than what a pixel averages, and Gaussians become too thin (docs/decisions, 050)."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything that a run depends on besides the scene.

    Attributes:
        method: the method's name in the registry (``mrgs.runs.registry``).
        batch: views per step.
        resolution: images wider than this many pixels are reduced to it; None keeps them.
        coarse_until: share of the training in which photos and renderings are coarser: a quarter of
            the photos' resolution in its first half, half of it in the second; not in the paper.
        seed: of every random choice.
        sh_every: steps between the degrees of the spherical harmonics.
        shares_opacity: blend both modalities with o_c.
        dilation_px2: added to the diagonal of the Gaussians' projected covariances; 0.3 px² in 3DGS
            and the paper.
        angular_dilation: cameras with coarser pixels than those of the finest photos, often the
            thermal ones, dilate by the same angle rather than by as many px²; not in the paper.
        temperature_sh_degree: degree of the temperature's spherical harmonics: 0 as published, t_i
            does not depend on the view. None for 3 where thermal photos have no °C, whose greys may
            depend on what else a photo shows (automatic gain), and 0 where they have.
        distant_points: start with points far away too, in the directions where no start point lies;
            not in the paper.
        photo_temperatures: start with temperatures read off the thermal photos, not with one for
            all, and with a larger o_t there; not in the paper.
        fitted_residuals: steps in which t̂ is fitted to these temperatures before the training, so
            that t_i starts as the remainder; not in the paper.
        neighbours_every: steps after which the neighbours are searched again, besides whenever N
            changes.
        checkpoint_every: steps between checkpoints; there is one every two minutes besides, unless
            writing takes long.
        loss: L_c, L_t and L_smooth.
        radiation: L_boltz; None leaves it out.
        image_model: what the cameras do to the images; nothing as published.
    """

    method: str = "mrgs"
    preset: Preset = "default"
    max_steps: int = 30_000
    batch: int = 1
    resolution: int | None = None
    coarse_until: float = 0.0
    seed: int = 0
    sh_every: int = 1_000
    shares_opacity: bool = False
    dilation_px2: float = DILATION_PX2
    angular_dilation: bool = False
    temperature_sh_degree: int | None = 0
    distant_points: bool = False
    photo_temperatures: bool = False
    fitted_residuals: int = 0
    neighbours_every: int = 500
    checkpoint_every: int = 1_000
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    radiation: RadiationConfig | None = dataclasses.field(default_factory=RadiationConfig)
    image_model: ImageModelConfig = dataclasses.field(default_factory=ImageModelConfig)
    optimizer: OptimizerConfig = dataclasses.field(default_factory=OptimizerConfig)
    densification: ConfiguredStrategy = dataclasses.field(default_factory=AdaptiveDensityControl)

    def __post_init__(self) -> None:
        schedule = ("max_steps", "batch", "sh_every", "neighbours_every", "checkpoint_every")
        require_within(self, schedule, 1, MOST_STEPS)
        require_within(self, ["fitted_residuals"], 0, MOST_STEPS)
        require_within(self, ["seed"], 0, MOST_SEED)
        require_within(self, ["coarse_until"], 0, 1)
        require_within(self, ["dilation_px2"], LEAST_DILATION_PX2, 1)
        if self.resolution is not None and self.resolution < 16:
            raise ConfigError(f"resolution must be at least 16 px, not {shown(self.resolution)}")
        if self.temperature_sh_degree not in (None, *range(MAX_DEGREE + 1)):
            degree = shown(self.temperature_sh_degree)
            raise ConfigError(f"temperature_sh_degree must be null or 0 to 3, not {degree}")

    def temperature_sh_degree_of(self, capture: Capture) -> int:
        """``temperature_sh_degree``, or what it is for these photos if that is None."""
        if self.temperature_sh_degree is not None:
            return self.temperature_sh_degree
        return MAX_DEGREE if capture.lacks_celsius else 0

    def dilation_of(self, capture: Capture) -> Dilation:
        """How a model of these photos is dilated."""
        finest = capture.finest_focal_px if self.angular_dilation else None
        return Dilation(self.dilation_px2, finest)

    def radiance_of(self, capture: Capture) -> BandRadiance | None:
        """The radiance as which a model blends temperatures; None to blend them as they are."""
        return capture.radiance if self.image_model.radiance else None

    def pixel_size_at(self, step: int) -> int:
        """Side of a pixel at this step, in pixels of the photos."""
        coarse_steps = self.coarse_until * self.max_steps
        if step < coarse_steps / 2:
            return 4
        return 2 if step < coarse_steps else 1

    def sh_degree_at(self, step: int) -> int:
        """Highest degree of the spherical harmonics in use at this step."""
        return min(MAX_DEGREE, step // self.sh_every)

    def temperature_sh_degree_at(self, step: int) -> int:
        """Highest degree of the temperature's spherical harmonics at this step, if there are any.
        Where it follows from the photos, every second step goes without them, as exports have only
        what does not depend on the view; a degree that is given is used as in 3DGS."""
        goes_without = self.temperature_sh_degree is None and step % 2 == 0
        return 0 if goes_without else self.sh_degree_at(step)


def make_config(
    method: str = DEFAULT_METHOD,
    preset: str = "default",
    max_steps: int | None = None,
    max_gaussians: int | None = None,
    resolution: int | None = None,
    seed: int = 0,
    batch: int = 1,
) -> TrainConfig:
    """The configuration of a method and a preset. ConfigError for an unknown method or preset, or a
    value that is not allowed.

    Args:
        method: ``mrgs`` is the published method, ``mrgs-base``, ``mrgs-fourier`` and ``mrgs-boltz``
            are its ablations, ``3dgs-rgbt`` is its baseline; ``mrgs-plus`` also models the thermal
            camera.
        preset: ``default`` (4,000 steps, at most 50,000 Gaussians) and ``fast`` (1,500 and 20,000)
            suit CPUs; ``paper`` is the published schedule of 30,000 steps.
        max_steps: the preset's whole schedule is stretched or shrunk to them.
        max_gaussians: cap on the Gaussians; None for the preset's.
        resolution: photos wider than this many pixels are reduced to it.
        seed: of every random choice.
        batch: views per step; with several, fewer and larger steps are taken.
    """
    if method not in METHODS:
        raise ConfigError(f"unknown method {shown(method)}; choose one of {', '.join(METHODS)}")
    if preset not in PRESETS:
        raise ConfigError(f"unknown preset {shown(preset)}; choose one of {', '.join(PRESETS)}")
    if resolution is not None:
        resolution = whole_number(resolution, "resolution")
    seed, batch = whole_number(seed, "seed"), whole_number(batch, "batch")
    config = _with_preset(TrainConfig(method=method, resolution=resolution, seed=seed), preset)
    config = _CHANGES[method](config)
    if batch != 1:
        config = _with_batch(config, batch)
    if max_steps is not None:
        config = with_steps(config, whole_number(max_steps, "max_steps"))
    if max_gaussians is not None:
        most = whole_number(max_gaussians, "max_gaussians")
        config = replace(config, densification=replace(config.densification, max_gaussians=most))
    return config


def _rgbt_baseline(config: TrainConfig) -> TrainConfig:
    """3DGS_RGB-T: one opacity, temperatures as harmonics, nothing of the paper's."""
    return replace(
        config,
        shares_opacity=True,
        temperature_sh_degree=MAX_DEGREE,
        field=replace(config.field, residuals=False),
        loss=replace(config.loss, smooth=0.0),
        radiation=None,
    )


def _without_heat(config: TrainConfig) -> TrainConfig:
    return replace(config, field=replace(config.field, fourier=False))


def _without_boltz(config: TrainConfig) -> TrainConfig:
    return replace(config, radiation=None)


def _plus(config: TrainConfig) -> TrainConfig:
    """Two opacities, temperatures of their own, a model of the thermal camera, L_opaque and L_dist;
    without embedding, heads, heat transformation and L_boltz, which gain nothing beside them. Start
    and losses are the same in all presets."""
    return replace(
        config,
        distant_points=True,
        photo_temperatures=True,
        temperature_sh_degree=None,
        field=replace(config.field, residuals=False, clamp_temperature=False),
        radiation=None,
        loss=replace(config.loss, **PLUS_LOSS),
        densification=replace(config.densification, split_longest=True),
        image_model=ImageModelConfig(
            radiance=True,
            air=True,
            point_spread=True,
            thermal_gain=True,
            thermal_drift=True,
            thermal_shading=True,
            poses=True,
        ),
        dilation_px2=PLUS_DILATION_PX2,
        angular_dilation=True,
    )


_CHANGES: Mapping[str, Callable[[TrainConfig], TrainConfig]] = {
    "mrgs": lambda config: config,
    "mrgs-base": lambda config: _without_boltz(_without_heat(config)),
    "mrgs-fourier": _without_boltz,
    "mrgs-boltz": _without_heat,
    "3dgs-rgbt": _rgbt_baseline,
    "mrgs-plus": _plus,
}
"""What each method changes in the configuration of ``mrgs`` (the paper's ablation table)."""

METHODS = tuple(_CHANGES)


def _with_preset(config: TrainConfig, preset: Preset) -> TrainConfig:
    """``paper`` is the published schedule; the others are for CPUs (docs/decisions, 008, 011, 017,
    039 and 040): they start with coarser photos, where these are large enough, and with
    temperatures as photos have them, to which t̂ is fitted at full scale. Half the published width
    of the heads is as good."""
    config = replace(config, preset=preset)
    if preset == "paper":
        return config
    steps, max_gaussians = {"fast": (1_500, 20_000), "default": (4_000, 50_000)}[preset]
    config = with_steps(config, steps)
    return replace(
        config,
        coarse_until=0.5,
        distant_points=True,
        photo_temperatures=True,
        fitted_residuals=300,
        densification=replace(config.densification, max_gaussians=max_gaussians, reset_every=None),
        field=replace(config.field, hidden_width=64, temperature_scale=1.0),
        loss=replace(config.loss, **SMOOTHNESS),
        optimizer=replace(config.optimizer, **CPU_RATES),
    )


def with_steps(config: TrainConfig, steps: int) -> TrainConfig:
    """The same schedule in another number of steps; the fit before it takes no more than these."""
    if steps < 1:
        raise ConfigError(f"max_steps must be at least 1, not {steps}")
    factor = steps / config.max_steps

    def scaled(count: int) -> int:
        return max(1, round(count * factor))

    radiation = config.radiation
    if radiation is not None:
        start = scaled(radiation.decay_from)
        end = max(scaled(radiation.decay_until), start + 1)
        radiation = replace(radiation, decay_from=start, decay_until=end)
    return replace(
        config,
        max_steps=steps,
        sh_every=scaled(config.sh_every),
        fitted_residuals=min(config.fitted_residuals, steps),
        radiation=radiation,
        densification=config.densification.rescaled(factor),
    )


def with_flat_field(config: TrainConfig, folder: Path, unit: str | None = None) -> TrainConfig:
    """The configuration with the camera's shading as in a folder of thermal photos of a uniform
    target, whose numbers have a unit such as ``kelvin*100`` unless their files say it. ConfigError
    if that is not a folder, or the image model has no shading."""
    model = config.image_model
    if not model.thermal_shading:
        raise ConfigError(
            f"a flat field needs a method that models the camera's shading, and {config.method} "
            f"does not: leave it out, or choose mrgs-plus",
            options=("flat_field",),
        )
    if not folder.is_dir():
        raise ConfigError(
            f"{folder} is not a folder: give the one with photos of a uniform target",
            options=("flat_field",),
        )
    model = replace(model, flat_field=str(folder.absolute()), flat_field_unit=unit)
    return replace(config, image_model=model)


def _with_batch(config: TrainConfig, batch: int) -> TrainConfig:
    """The same number of views in steps of several: what is counted in steps shrinks as the batch
    grows, and learning rates grow with its square root (docs/decisions, 040)."""
    if batch < 1:
        raise ConfigError(f"batch must be at least 1, not {batch}", options=("batch",))
    config = with_steps(config, max(1, round(config.max_steps / batch)))
    faster = math.sqrt(batch)
    return replace(
        config,
        batch=batch,
        neighbours_every=max(1, round(config.neighbours_every / batch)),
        checkpoint_every=max(1, round(config.checkpoint_every / batch)),
        optimizer=config.optimizer.faster(faster),
        image_model=config.image_model.faster(faster),
        densification=config.densification.with_batch(batch),
    )


def from_yaml(text: str, source: str, base: TrainConfig | None = None) -> TrainConfig:
    """The configuration that ``write_yaml`` wrote, or a part of one over another; see
    ``read_yaml``, which raises ``ConfigError``."""
    return read_yaml(TrainConfig, text, source, base)
