"""The runs of a comparison: their folders, what these have already, training and scoring."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias, cast

from mrgs.check import warn_of_problems
from mrgs.data import load_scene
from mrgs.errors import ConfigError, RunError, SceneError
from mrgs.evaluation import evaluate_run
from mrgs.evaluation.metrics import REPORTED, figure_names
from mrgs.evaluation.report import ScoredData
from mrgs.run_files.checkpoint import load_facts
from mrgs.run_files.facts import CheckpointFacts, changes, fingerprints, incompatibilities
from mrgs.run_files.folder import RunConfig, RunFolder
from mrgs.runs.open import method_of, open_run
from mrgs.runs.registry import find_method
from mrgs.scene import Scene
from mrgs.system.atomic import write_text
from mrgs.system.disk import read_text
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import flat, parse_yaml
from mrgs.system.wording import counted
from mrgs.training import make_config
from mrgs.training.start import Hooks, TrainOptions

OnStep: TypeAlias = Callable[[Any], bool | None]
"""Called with a step's statistics (``step``, ``gaussians``); returning True stops the training."""

Scores: TypeAlias = dict[str, Any]
"""The content of a ``metrics.json``."""


def run_one(
    scene: Path,
    folder: Path,
    config: RunConfig,
    *,
    device: DeviceName = "auto",
    lpips_weights: Path | None = None,
    on_step: OnStep | None = None,
    on_score: Callable[[int, int], None] | None = None,
) -> bool:
    """Train, continue, or only score one run, depending on its state, on a GPU if the method can;
    returns whether it is scored. ``on_step``, called after every training step, stops it, with a
    checkpoint, by returning True; ``on_score`` is called with the numbers of scored views and of
    all. MrgsError if the scene or the folder cannot be used, or the training had to stop."""
    method = find_method(config.method)
    device = device if method.uses_gpu else "cpu"
    if not _is_trained(folder, config):
        resume = bool(RunFolder(folder).checkpoints())
        method.train(scene, folder, config, TrainOptions(resume, device=device), Hooks(on_step))
    run = open_run(folder, scene, device)
    if run.facts.step < config.max_steps:
        return False
    evaluate_run(run, lpips_weights, on_score)
    return True


def is_scored(scores: Scores | None, folder: Path, config: RunConfig, with_lpips: bool) -> bool:
    """Whether scores are of the finished run, with LPIPS if required. Scores of an older version,
    which lack a figure, do not count if the run can be scored again."""
    if scores is None or scores.get("steps") != config.max_steps:
        return False
    names = {modality.name: set(figure_names(modality)) for modality in REPORTED}
    is_complete = all(_means(scores, name).keys() >= own for name, own in names.items())
    if not is_complete and _is_trained(folder, config):
        return False
    return not with_lpips or any(
        _means(scores, group).get("lpips") is not None for group in scores.get("mean") or {}
    )


def run_scores(folder: Path) -> Scores | None:
    """The scores in a run's folder; None if there are none, or unreadable ones."""
    return read_metrics(folder / "eval")


def read_metrics(folder: Path) -> Scores | None:
    """The content of a folder's ``metrics.json``; None if it is missing or unreadable."""
    try:
        document = json.loads(read_text(folder / "metrics.json"))
    except (OSError, ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def require_same_config(folder: Path, config: RunConfig, scores: Scores | None) -> None:
    """Check that the run or the scores in a folder have this configuration. ConfigError if it was
    trained with another, whose message names the first value that differs; RunError if its
    configuration cannot be read."""
    run = RunFolder(folder)
    if not run.config_file.exists() or not (run.checkpoints() or scores):
        return
    found = run.read_config(method_of(run).read_config)
    there, here = (flat(dataclasses.asdict(cast(Any, each))) for each in (found, config))
    differ = (name for name in [*here, *there] if here.get(name) != there.get(name))
    if (name := next(differ, None)) is not None:
        raise ConfigError(
            f"{folder} holds a run with another configuration ({name} is {there.get(name)} "
            f"there and {here.get(name)} here): choose another folder, or remove this one",
            options=("output",),
        )


def _is_trained(folder: Path, config: RunConfig) -> bool:
    """Whether there is a checkpoint of the last step, by its name."""
    return config.max_steps in (
        int(path.stem.removeprefix("step_")) for path in RunFolder(folder).checkpoints()
    )


def _means(scores: Scores, group: str) -> dict[str, Any]:
    """A group's means; empty if the scores have another shape."""
    means = scores.get("mean")
    figures = means.get(group) if isinstance(means, dict) else None
    return figures if isinstance(figures, dict) else {}


class SceneData:
    """The present data of a scene; its photos are read once, when a run is compared with it."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @cached_property
    def facts(self) -> CheckpointFacts:
        """The facts of a run that began now."""
        return CheckpointFacts.at_start(self.scene)

    @cached_property
    def _scored(self) -> ScoredData:
        """The data of scores that were computed now."""
        return ScoredData.of(self.scene, self.facts.images)

    def changed_since(self, scores: Scores | None) -> str:
        """How the scene differs from the data of scores; empty if it does not, or they name none.
        SceneError if a photo cannot be read."""
        scored = ScoredData.from_json((scores or {}).get("data"))
        return "" if scored is None else scored.changes(self._scored, self.scene)


def require_same_data(folder: Path, data: SceneData, scores: Scores | None) -> None:
    """Check that a run was trained on the present data of its scene; held-out images may differ if
    there is a checkpoint to score again. ConfigError if it was trained, or scored, on other data,
    which says what has changed; SceneError if a photo cannot be read."""
    facts = None  # of the newest readable checkpoint; the run itself reports others
    for checkpoint in RunFolder(folder).checkpoints():
        with suppress(RunError):
            facts = load_facts(checkpoint)
    if facts is None:
        changed = data.changed_since(scores)
    elif (facts.images, facts.temperature) == (data.facts.images, data.facts.temperature):
        return  # without reading all photos for every run
    else:
        changed = differences(facts, data.scene)
    if changed:
        raise ConfigError(
            f"{folder} holds a run of other data than {data.scene.name} has now ({changed}): "
            f"choose another folder, or remove this one",
            options=("output",),
        )


def differences(facts: CheckpointFacts, scene: Scene) -> str:
    """How a scene differs from the run's, for a message; empty if it does not. SceneError if a
    photo cannot be read."""
    for what, _ in incompatibilities(facts, scene):
        return f"it {what}"
    return changes(facts.images, fingerprints(scene), scene)


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
    """A configuration of any method, as ``write_yaml`` wrote it. ConfigError for any other text."""
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
