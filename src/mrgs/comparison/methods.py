"""The methods that can be compared: their configurations, and how each is trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from mrgs.baselines import thermonerf
from mrgs.baselines.thermonerf import ThermoNerfConfig, run_files, train_thermonerf
from mrgs.baselines.thermonerf.config import is_thermonerf
from mrgs.baselines.thermonerf.config import to_yaml as thermonerf_yaml
from mrgs.errors import ConfigError
from mrgs.method.config import to_yaml
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import parse_yaml
from mrgs.training import TrainConfig, from_yaml, make_config, train
from mrgs.training.run_folder import RunFolder

DEFAULT_METHODS = ("3dgs-rgbt", "mrgs-base", "mrgs-fourier", "mrgs-boltz", "mrgs", "mrgs-plus")

AnyConfig: TypeAlias = TrainConfig | ThermoNerfConfig
OnStep: TypeAlias = Callable[[Any], bool | None]
"""Called with a step's statistics, which have ``step`` and ``gaussians``; returning True stops the
training."""


@dataclass(frozen=True)
class Variant:
    """A method with some values changed, which has rows of its own in the tables.

    Attributes:
        name: what the tables call it.
        method: any that ``mrgs train`` knows.
        changes: the values that differ from the method's, as YAML; empty for none.
        source: where the changes come from, for messages.
    """

    name: str
    method: str
    changes: str = ""
    source: str = ""

    @classmethod
    def from_text(cls, name: str, text: str, source: str) -> Variant:
        """A variant from YAML that names its method and what differs, as for ``mrgs train
        --config``.

        Raises:
            ConfigError: it is not YAML, or does not name a method.
        """
        values = parse_yaml(text, source)
        if not isinstance(values, dict) or not isinstance(values.get("method"), str):
            raise ConfigError(
                f"{source} does not say which method it changes: add a line such as method: mrgs"
            )
        return cls(name, values["method"], text, source)


@dataclass(frozen=True)
class Options:
    """What is compared, and what every run shares.

    Attributes:
        methods: any that ``mrgs train`` knows, in the order of the tables' rows.
        variants: methods with changed values; their rows come after those of the methods.
        neighbours: n of the paper's Table 4; each is a run of ``mrgs``.
        seeds: how many seeds, from 0.
        preset: the preset's name.
        max_steps: training steps; None keeps the preset's.
        max_gaussians: cap on the Gaussians; None keeps the preset's.
        resolution: images wider than this many pixels are reduced to it; None keeps them.
    """

    methods: tuple[str, ...] = DEFAULT_METHODS
    variants: tuple[Variant, ...] = ()
    neighbours: tuple[int, ...] = ()
    seeds: int = 1
    preset: str = "default"
    max_steps: int | None = None
    max_gaussians: int | None = None
    resolution: int | None = None


def configure(variant: Variant, options: Options, seed: int) -> AnyConfig:
    """The configuration of one run.

    Args:
        variant: the method, and what differs from it.
        options: what all runs share; a variant's own values count before these, but for the
            resolution.
        seed: of every random choice.

    Raises:
        ConfigError: an unknown method or preset, a value that is not allowed, or a variant with
            another resolution.
    """
    config = _configure(variant, options, seed)
    if config.resolution != options.resolution:
        raise ConfigError(
            f"{variant.source} has a resolution of its own, but all runs are compared at one "
            f"size: take it out, and "
            "give --resolution"
        )
    return config


def _configure(variant: Variant, options: Options, seed: int) -> AnyConfig:
    if variant.method == thermonerf.METHOD:
        nerf = thermonerf.make_config(options.preset, options.max_steps, options.resolution, seed)
        return (
            replace(thermonerf.from_yaml(variant.changes, variant.source, nerf), seed=seed)
            if variant.changes
            else nerf
        )
    config = make_config(
        variant.method,
        options.preset,
        options.max_steps,
        options.max_gaussians,
        options.resolution,
        seed,
    )
    return (
        replace(from_yaml(variant.changes, variant.source, config), seed=seed)
        if variant.changes
        else config
    )


def device_of(config: AnyConfig, device: DeviceName) -> DeviceName:
    """Where a run of this configuration works: ThermoNeRF on the CPU, all others where they are
    asked to."""
    return "cpu" if isinstance(config, ThermoNerfConfig) else device


def train_run(
    scene: Path,
    folder: Path,
    config: AnyConfig,
    on_step: OnStep | None = None,
    device: DeviceName = "auto",
) -> None:
    """Train a run, or continue it if its folder has a checkpoint.

    Raises:
        MrgsError: the scene or the folder cannot be used, or the training had to stop.
    """
    resume = bool(RunFolder(folder).checkpoints())
    if isinstance(config, ThermoNerfConfig):
        train_thermonerf(scene, folder, config, resume=resume, on_step=on_step)
    else:
        train(scene, folder, config, resume=resume, device=device, on_step=on_step)


def to_text(config: AnyConfig) -> str:
    """The configuration as YAML."""
    return thermonerf_yaml(config) if isinstance(config, ThermoNerfConfig) else to_yaml(config)


def from_text(text: str) -> AnyConfig:
    """The configuration that ``to_text`` wrote.

    Raises:
        ConfigError: it is not a configuration.
    """
    return (
        thermonerf.from_yaml(text, "the request")
        if is_thermonerf(text)
        else from_yaml(text, "the request")
    )


def read_config(folder: RunFolder) -> AnyConfig:
    """The configuration of a run of any method.

    Raises:
        RunError: the folder is not a run, or its configuration cannot be used.
    """
    return (
        run_files.read_config(folder)
        if run_files.holds_thermonerf(folder)
        else folder.read_config()
    )
