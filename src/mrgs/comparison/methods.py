"""The methods that are compared, and their configurations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from mrgs.errors import ConfigError
from mrgs.run_files.folder import RunConfig
from mrgs.runs.registry import find_method
from mrgs.system.strict_yaml import parse_yaml

DEFAULT_METHODS = ("3dgs-rgbt", "mrgs-base", "mrgs-fourier", "mrgs-boltz", "mrgs", "mrgs-plus")


@dataclass(frozen=True)
class Variant:
    """A method with some values changed, which has rows of its own in the tables.

    Attributes:
        name: in tables.
        method: a registered method.
        changes: the values that differ from the method's, as YAML; empty for none.
        source: of the changes, for messages.
    """

    name: str
    method: str
    changes: str = ""
    source: str = ""

    @classmethod
    def from_text(cls, name: str, text: str, source: str) -> Variant:
        """A variant from YAML with its method and what differs, as for ``mrgs train --config``.

        Raises:
            ConfigError: it is not YAML, or names no method.
        """
        return cls(name, _method_in(text, source), text, source)


@dataclass(frozen=True)
class Options:
    """Methods to compare, and the settings that all runs share.

    Attributes:
        methods: registered methods, in the order of the tables' rows.
        variants: methods with changed values; their rows follow.
        neighbours: n of the paper's Table 4; each is a run of ``mrgs``.
        seeds: number of seeds, from 0.
        preset: of every run.
        max_steps: training steps; None for the preset's.
        max_gaussians: cap on the Gaussians; None for the preset's.
        resolution: images wider than this many pixels are downscaled to it; None keeps them.
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
    """The configuration of one run of a method on a scene; the values of a variant override the
    options that all runs share.

    Raises:
        ConfigError: an unknown method or preset, a value that is not allowed, or a variant with
            another resolution.
    """
    config: Any = find_method(variant.method).configure(
        options.preset,
        max_steps=options.max_steps,
        max_gaussians=options.max_gaussians,
        resolution=options.resolution,
        seed=seed,
        changes=variant.changes,
        source=variant.source,
    )
    if config.resolution != options.resolution:
        raise ConfigError(
            f"{variant.source} has a resolution of its own, but all runs are compared at one "
            f"size: take it out, and give that of all runs",
            options=("resolution",),
        )
    configured: RunConfig = replace(config, seed=seed)
    return configured


def from_text(text: str) -> RunConfig:
    """A configuration of any method, as ``write_yaml`` wrote it.

    Raises:
        ConfigError: it is not a configuration.
    """
    method = find_method(_method_in(text, "the request"))
    config: RunConfig = method.read_config(text, "the request")
    return config


def _method_in(text: str, source: str) -> str:
    values = parse_yaml(text, source)
    method = values.get("method") if isinstance(values, dict) else None
    if not isinstance(method, str):
        raise ConfigError(f"{source} names no method: add a line such as method: mrgs")
    return method
