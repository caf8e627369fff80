"""The methods that can be compared: their configurations, and how each is trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias, cast

from mrgs.errors import ConfigError
from mrgs.runs.open import method_of
from mrgs.runs.registry import find_method
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import parse_yaml
from mrgs.training.run_folder import RunConfig, RunFolder

DEFAULT_METHODS = ("3dgs-rgbt", "mrgs-base", "mrgs-fourier", "mrgs-boltz", "mrgs", "mrgs-plus")

OnStep: TypeAlias = Callable[[Any], bool | None]
"""Called with a step's statistics, which have ``step`` and ``gaussians``; returning True stops the
training."""


@dataclass(frozen=True)
class Variant:
    """A method with some values changed, which has rows of its own in the tables.

    Attributes:
        name: what the tables call it.
        method: any that is registered.
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
    """Methods to compare, and the settings that all runs share.

    Attributes:
        methods: any that are registered, in the order of the tables' rows.
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


def configure(variant: Variant, options: Options, seed: int) -> RunConfig:
    """The configuration of one run of a method on a scene.

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
            f"size: take it out, and give that of all runs",
            options=("resolution",),
        )
    return config


def _configure(variant: Variant, options: Options, seed: int) -> RunConfig:
    config: RunConfig = find_method(variant.method).configure(
        options.preset,
        max_steps=options.max_steps,
        max_gaussians=options.max_gaussians,
        resolution=options.resolution,
        seed=seed,
        changes=variant.changes,
        source=variant.source,
    )
    return replace(cast(Any, config), seed=seed)


def device_of(config: RunConfig, device: DeviceName) -> DeviceName:
    """The device for a run of this configuration: the requested one, if its method can use a
    GPU."""
    return device if find_method(config.method).uses_gpu else "cpu"


def train_run(
    scene: Path,
    folder: Path,
    config: RunConfig,
    on_step: OnStep | None = None,
    device: DeviceName = "auto",
) -> None:
    """Train a run, or continue it if its folder has a checkpoint.

    Raises:
        MrgsError: the scene or the folder cannot be used, or the training had to stop.
    """
    resume = bool(RunFolder(folder).checkpoints())
    find_method(config.method).train(
        scene, folder, config, resume=resume, device=device_of(config, device), on_step=on_step
    )


def from_text(text: str) -> RunConfig:
    """The configuration of any method that ``write_yaml`` wrote.

    Raises:
        ConfigError: it is not a configuration.
    """
    values = parse_yaml(text, "the request")
    if not isinstance(values, dict) or not isinstance(values.get("method"), str):
        raise ConfigError("the request must hold the fields of a configuration")
    config: RunConfig = find_method(values["method"]).read_config(text, "the request")
    return config


def read_config(folder: RunFolder) -> RunConfig:
    """The configuration of a run of any method.

    Raises:
        RunError: the folder is not a run, or its configuration cannot be used.
    """
    return folder.read_config(method_of(folder).read_config)
