"""The methods that can be compared: their configurations, and how each is trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from mrgs import thermonerf
from mrgs.thermonerf import ThermoNerfConfig, run_files, train_thermonerf
from mrgs.thermonerf.config import is_thermonerf
from mrgs.thermonerf.config import to_yaml as thermonerf_yaml
from mrgs.training import TrainConfig, from_yaml, make_config, train
from mrgs.training.config import to_yaml
from mrgs.training.run_folder import RunFolder

DEFAULT_METHODS = ("3dgs-rgbt", "mrgs-base", "mrgs-fourier", "mrgs-boltz", "mrgs", "mrgs-plus")

AnyConfig: TypeAlias = TrainConfig | ThermoNerfConfig
OnStep: TypeAlias = Callable[[Any], bool | None]
"""Called with a step's statistics, which have ``step`` and ``gaussians``; returning True stops the training."""


@dataclass(frozen=True)
class Options:
    """What is compared, and what every run shares.

    Attributes:
        methods: any that ``mrgs train`` knows, in the order of the tables' rows.
        neighbours: n of the paper's Table 4; each is a run of ``mrgs``.
        seeds: how many seeds, from 0.
        preset: the preset's name.
        max_steps: training steps; None keeps the preset's.
        max_gaussians: cap on the Gaussians; None keeps the preset's.
        resolution: images wider than this many pixels are reduced to it; None keeps them.
    """

    methods: tuple[str, ...] = DEFAULT_METHODS
    neighbours: tuple[int, ...] = ()
    seeds: int = 1
    preset: str = "default"
    max_steps: int | None = None
    max_gaussians: int | None = None
    resolution: int | None = None


def configure(method: str, options: Options, seed: int, neighbours_n: int | None = None) -> AnyConfig:
    """The configuration of one run.

    Args:
        method: any that ``mrgs train`` knows.
        options: what all runs share.
        seed: of every random choice.
        neighbours_n: n of the paper's Table 4, in place of the method's own; for methods with Gaussians.

    Raises:
        ConfigError: an unknown method or preset, or a value that is not allowed.
    """
    if method == thermonerf.METHOD:
        return thermonerf.make_config(options.preset, options.max_steps, options.resolution, seed)
    config = make_config(method, options.preset, options.max_steps, options.max_gaussians, options.resolution, seed)
    if neighbours_n is not None:
        config = replace(config, field=replace(config.field, neighbours_n=neighbours_n))
    return config


def train_run(scene: Path, folder: Path, config: AnyConfig, on_step: OnStep | None = None) -> None:
    """Train a run, or continue it if its folder has a checkpoint.

    Raises:
        MrgsError: the scene or the folder cannot be used, or the training had to stop.
    """
    resume = bool(RunFolder(folder).checkpoints())
    if isinstance(config, ThermoNerfConfig):
        train_thermonerf(scene, folder, config, resume=resume, on_step=on_step)
    else:
        train(scene, folder, config, resume=resume, on_step=on_step)


def to_text(config: AnyConfig) -> str:
    """The configuration as YAML."""
    return thermonerf_yaml(config) if isinstance(config, ThermoNerfConfig) else to_yaml(config)


def from_text(text: str) -> AnyConfig:
    """The configuration that ``to_text`` wrote.

    Raises:
        ConfigError: it is not a configuration.
    """
    return thermonerf.from_yaml(text, "the request") if is_thermonerf(text) else from_yaml(text, "the request")


def read_config(folder: RunFolder) -> AnyConfig:
    """The configuration of a run of any method.

    Raises:
        RunError: the folder is not a run, or its configuration cannot be used.
    """
    return run_files.read_config(folder) if run_files.holds_thermonerf(folder) else folder.read_config()
