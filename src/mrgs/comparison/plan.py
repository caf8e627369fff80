"""The runs of a comparison, and their folders."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mrgs.check import warn_of_problems
from mrgs.comparison.runs import (
    SceneData,
    Scores,
    require_same_config,
    require_same_data,
    run_scores,
)
from mrgs.data import load_scene
from mrgs.errors import ConfigError, SceneError
from mrgs.run_files.folder import RunConfig
from mrgs.runs.registry import find_method
from mrgs.system.atomic import write_text
from mrgs.system.disk import read_text
from mrgs.system.strict_yaml import parse_yaml
from mrgs.system.wording import counted
from mrgs.training import make_config

NEIGHBOURS_METHOD = "mrgs"
"""The method whose number of neighbours the paper's Table 4 varies."""

DEFAULT_METHODS = ("3dgs-rgbt", "mrgs-base", "mrgs-fourier", "mrgs-boltz", "mrgs", "mrgs-plus")


@dataclass(frozen=True)
class Variant:
    """A method with some values changed, which has rows of its own in the tables. ``changes`` are
    the values that differ from the method's, as YAML; empty for none."""

    name: str
    method: str
    changes: str = ""
    source: str = ""

    @classmethod
    def from_text(cls, name: str, text: str, source: str) -> Variant:
        """A variant from YAML with its method and what differs, as for ``mrgs train --config``.
        ConfigError if it is not YAML, or names no method."""
        return cls(name, _method_in(text, source), text, source)


@dataclass(frozen=True)
class Options:
    """Methods to compare, and the settings that all runs share.

    Attributes:
        methods: registered methods, in the order of the tables' rows.
        variants: methods with changed values; their rows follow.
        neighbours: n of the paper's Table 4; each is a run of ``mrgs``.
        seeds: number of seeds, from 0.
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

    def setup(self, held_out: int) -> str:
        """The settings in words, with the number of held-out views of all scenes."""
        steps = "" if self.max_steps is None else f", {self.max_steps:,} steps"
        cap = "" if self.max_gaussians is None else f", at most {self.max_gaussians:,} Gaussians"
        width = "" if self.resolution is None else f", images at most {self.resolution:,} px wide"
        seeds = counted(self.seeds, "seed")
        views = counted(held_out, "held-out view")
        return f"{seeds}; preset {self.preset}{steps}{cap}{width}; {views}."


def configure(variant: Variant, options: Options, seed: int) -> RunConfig:
    """The configuration of one run of a method on a scene; the values of a variant override the
    options that all runs share. ConfigError for an unknown method or preset, a value that is not
    allowed, or a variant with another resolution."""
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
    """A configuration of any method, as ``write_yaml`` wrote it. ConfigError if it is none."""
    method = find_method(_method_in(text, "the request"))
    config: RunConfig = method.read_config(text, "the request")
    return config


def _method_in(text: str, source: str) -> str:
    values = parse_yaml(text, source)
    method = values.get("method") if isinstance(values, dict) else None
    if not isinstance(method, str):
        raise ConfigError(f"{source} names no method: add a line such as method: mrgs")
    return method


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """A run of a comparison, before it is trained: ``scene`` is the absolute path of the scene's
    folder or transforms file, ``method`` the name in tables, unique among the methods, and
    ``scores`` those of an earlier call; None if there are none, or of other held-out images."""

    scene: Path
    scene_name: str
    method: str
    seed: int
    config: RunConfig
    folder: Path
    scores: Scores | None = None

    def __str__(self) -> str:
        return f"{self.scene_name}, {self.method}, seed {self.seed}"


def plan(scenes: Sequence[Path], output: Path, options: Options) -> list[PlannedRun]:
    """All runs in their order of execution: every table is complete after the first seed.
    SceneError if a scene cannot be read, or has no held-out views; ConfigError if an option is not
    allowed, two scenes have one name, or a run's folder has another run, or one of other data."""
    if options.seeds < 1:
        raise ConfigError(
            f"the number of seeds must be at least 1, not {options.seeds}", options=("seeds",)
        )
    variants = {method: Variant(method, method) for method in options.methods}
    variants |= {variant.name: variant for variant in options.variants}
    for n, name in neighbour_methods(options).items():
        changes = f"field: {{neighbours_n: {n}}}"
        variants.setdefault(name, Variant(name, NEIGHBOURS_METHOD, changes, f"neighbours n = {n}"))
    if not variants:
        raise ConfigError(
            "there is nothing to compare: name at least one method", options=("methods",)
        )
    named = _named(scenes, options.resolution)
    jobs = []
    for seed in range(options.seeds):
        for name, data in named.items():
            scene = Path(data.scene.path)
            for label, variant in variants.items():
                folder = output / "runs" / name / label / f"seed_{seed}"
                jobs.append(
                    PlannedRun(scene, name, label, seed, configure(variant, options, seed), folder)
                )
    _claim(output / "scenes.json", {name: data.scene.path for name, data in named.items()})
    for index, job in enumerate(jobs):
        data, scores = named[job.scene_name], run_scores(job.folder)
        require_same_config(job.folder, job.config, scores)
        require_same_data(job.folder, data, scores)
        if not data.changed_since(scores):
            jobs[index] = replace(job, scores=scores)
    return jobs


def neighbour_methods(options: Options) -> dict[int, str]:
    """The method's name for each n of the table of neighbours; ``mrgs`` for its own n."""
    own_n = make_config(NEIGHBOURS_METHOD, options.preset).field.neighbours_n
    return {
        n: NEIGHBOURS_METHOD if n == own_n else f"{NEIGHBOURS_METHOD}-n{n}"
        for n in options.neighbours
    }


def _named(scenes: Sequence[Path], resolution: int | None) -> dict[str, SceneData]:
    """The scenes by their folder's name, each checked."""
    if not scenes:
        raise ConfigError("there is nothing to compare: name at least one scene")
    named: dict[str, SceneData] = {}
    for scene in scenes:
        loaded = load_scene(scene, resolution=resolution)
        if not loaded.eval:
            raise SceneError(
                f"{scene}: no views are held out, so there is nothing to score; put 'eval' into "
                f"the file names of some, or list them in val_filenames"
            )
        with suppress(SceneError):  # a photo that cannot be read: the runs report it
            warn_of_problems(loaded)
        other = named.setdefault(loaded.name, SceneData(loaded)).scene.path
        if other != loaded.path:
            raise ConfigError(
                f"{other} and {loaded.path} have the same name: rename one of the folders"
            )
    return named


def _claim(file: Path, named: dict[str, str]) -> None:
    """Record the folder of each scene's name, so that no other scene takes over its runs."""
    known: dict[str, str] = {}
    if file.exists():
        try:
            known = dict(json.loads(read_text(file)))
        except (OSError, ValueError, TypeError):
            raise ConfigError(
                f"{file} cannot be read: choose another folder, or remove the file",
                options=("output",),
            ) from None
    for name, path in named.items():
        if known.setdefault(name, path) != path:
            raise ConfigError(
                f"{file.parent} holds runs of {known[name]} under the name {name}: choose another "
                f"folder, or, if the scene was moved, correct its path in {file}",
                options=("output",),
            )
    write_text(file, json.dumps(known, indent=2) + "\n")
