"""A training of Gaussians: started or resumed, checked, and run to its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from mrgs.check import warn_of_problems
from mrgs.data import load_scene
from mrgs.errors import ConfigError
from mrgs.method.config import TrainConfig, from_yaml
from mrgs.method.density import Strategy
from mrgs.method.losses.term import Term
from mrgs.method.losses.terms import configured_terms
from mrgs.render import Model
from mrgs.run_files.checkpoint import load_facts
from mrgs.run_files.facts import CheckpointFacts, facts_to_resume, require_scene
from mrgs.run_files.folder import CHECKPOINTS_KEPT, C, ReadConfig, RunConfig, RunFolder, T
from mrgs.scene import CameraResponse, Scene
from mrgs.scene.capture import model_modalities
from mrgs.system import gpu
from mrgs.system.disk import warn_if_short
from mrgs.system.gpu import HOST, DeviceName
from mrgs.system.operation import disable_kernels
from mrgs.system.strict_yaml import whole_number
from mrgs.system.threads import require_own_threads, will_compute
from mrgs.system.torch_modes import own_modes, seeded
from mrgs.training import checkpoint
from mrgs.training.kernel_check import full_name, warn_of_missing
from mrgs.training.loop import Trainer, Validation
from mrgs.training.memory import checkpoint_bytes
from mrgs.training.state import TrainingState, initial_state


@dataclass(frozen=True)
class TrainOptions:
    """How a run of any method is trained, without effect on its result: ``mrgs.train`` describes
    the keywords of these names."""

    resume: bool = False
    accept_changes: bool = False
    device: DeviceName = "auto"
    plain: bool = False
    tensorboard: bool = False


@dataclass(frozen=True)
class Hooks:
    """Functions that a training calls: ``mrgs.train`` describes the keywords of these names.
    Methods without Gaussians do not call ``on_model``, and have no ``validation``."""

    on_step: Callable[[Any], object] | None = None
    on_start: Callable[[Scene, Any], object] | None = None
    on_model: Callable[[Model, CameraResponse], object] | None = None
    progress: Callable[[int, int], object] | None = None
    validation: Validation | None = None


class TrainingPart(NamedTuple):
    """A training of a part of a scene: the numbers of the training views that take part, in
    ascending order; density control, which defines which Gaussians move; and what returns the state
    at step 0, from the scene, the configuration and the device."""

    views: Sequence[int]
    strategy: Strategy
    start: Callable[[Scene, TrainConfig, torch.device], TrainingState]


DEFAULT_OPTIONS, NO_HOOKS = TrainOptions(), Hooks()


def train(
    scene: Scene | str | Path,
    output: str | Path,
    config: TrainConfig,
    options: TrainOptions = DEFAULT_OPTIONS,
    hooks: Hooks = NO_HOOKS,
    *,
    stop_at: int | None = None,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
    part: TrainingPart | None = None,
) -> RunFolder:
    """Train a model of a scene, or of a part of it, into a run folder; see ``mrgs.train``, which
    also opens the run. A resumed run needs its strategy, terms and part again. MrgsError as for
    ``mrgs.train``."""
    if stop_at is not None and whole_number(stop_at, "stop_at") < 1:
        raise ConfigError(f"stop_at must be at least 1, not {stop_at}", options=("stop_at",))
    opened = open_training(
        scene, output, config, options, hooks, strategy=strategy, terms=terms, part=part
    )
    with opened as trainer:
        if hooks.on_model is not None:
            hooks.on_model(trainer.state.model, _response_of(trainer.state))
        trainer.check_kernels()
        trainer.run(stop_at, hooks.on_step, hooks.progress)
    return trainer.folder


@contextmanager
def open_training(
    scene: Scene | str | Path,
    output: str | Path,
    config: TrainConfig,
    options: TrainOptions = DEFAULT_OPTIONS,
    hooks: Hooks = NO_HOOKS,
    *,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
    part: TrainingPart | None = None,
) -> Iterator[Trainer]:
    """Around a training: the folder locked, a trainer ready for its first step; see ``train``."""
    folder, device = RunFolder(output), gpu.choose_device(options.device)
    custom = strategy if part is None else None
    strategy = strategy if part is None else part.strategy
    if isinstance(scene, Scene) and not options.resume:
        config = replace(config, resolution=scene.resolution)
    begun = begun_run(
        folder,
        scene,
        config,
        options,
        hooks,
        read=from_yaml,
        load=lambda path, own: checkpoint.load_state(path, own, device, strategy, terms),
        start=lambda scene, own: (
            initial_state(scene, own, device, strategy, terms)
            if part is None
            else part.start(scene, own, device)
        ),
    )
    with begun as (loaded, config, state, facts):
        count = len(loaded.train if part is None else part.views)
        if config.batch > count:  # the views of a step differ
            raise ConfigError(
                f"a batch of {config.batch} is more than the {count} training views of "
                f"{loaded.name}: choose a smaller one",
                options=("batch",),
            )
        if hooks.validation is not None and not loaded.eval:
            why = f"{loaded.name} holds out no views to score: hold some out, or ask for no scores"
            raise ConfigError(why, options=("eval_steps",))
        if options.resume:
            warn_of_missing(folder.custom_parts)
        folder.note_custom_parts(_custom_parts(config, loaded, custom, terms))
        most = max(config.densification.max_gaussians, len(state.model.gaussians))
        size = checkpoint_bytes(config, loaded.modalities, most)
        # The kept checkpoints and the one being written.
        warn_if_short(folder.path, (CHECKPOINTS_KEPT + 1) * size, "this run")
        if part is not None:
            state.sampler.restrict(part.views)
        # A resumed run continues with the cameras as they are now.
        state.model.dilation = config.dilation_of(facts.capture)
        log = folder.tensorboard_log(facts.step) if options.tensorboard else nullcontext()
        with own_modes():
            trainer = Trainer(folder, facts, loaded, config, state, hooks.validation)
        with log, closing(trainer):
            yield trainer


def _custom_parts(
    config: TrainConfig, scene: Scene, strategy: Strategy | None, terms: Sequence[Term]
) -> Iterator[str]:
    """The strategy and the terms that a training has from Python."""
    if strategy is not None:
        yield f"strategy: {type(strategy).__module__}.{strategy!r}"
    with seeded(config.seed):
        configured = configured_terms(config, (), model_modalities(scene.modalities))
    for term in terms:
        replaces = term.name in [each.name for each in configured]
        place = ", in place of the configured one" if replaces else ""
        yield f"term: {term.name}: {full_name(type(term))}{place}"


@contextmanager
def begun_run(
    folder: RunFolder,
    scene: Scene | str | Path,
    config: C,
    options: TrainOptions,
    hooks: Hooks,
    *,
    read: ReadConfig[C],
    load: Callable[[Path, C], T],
    start: Callable[[Scene, C], T],
) -> Iterator[tuple[Scene, C, T, CheckpointFacts]]:
    """Within this block the folder of a run of any method is locked. Its scene, its configuration,
    and the state of its newest checkpoint or, where it is not resumed, a new one; see ``train``."""
    if options.resume:
        config = folder.read_whole_config(read)
    else:
        folder.require_new()
    loaded = scene_to_train(scene, config)
    with folder.training(config, options.resume), disable_kernels(options.plain):
        if hooks.on_start is not None:
            hooks.on_start(loaded, config)
        with own_modes():
            if options.resume:
                state, facts = folder.load_newest(
                    lambda path: (load(path, config), load_facts(path)), set_aside=True
                )
                facts = facts_to_resume(facts, loaded, options.accept_changes)
                folder.cut_log(facts.step)
            else:
                facts = CheckpointFacts.at_start(loaded)
                state = start(loaded, config)
        yield loaded, config, state, facts


def scene_to_train(scene: Scene | str | Path, config: RunConfig) -> Scene:
    """The scene that a run of any method is trained on; a given one keeps its resolution. MrgsError
    if the scene cannot be used, torch's default type is not float32, or this process was forked
    from one that has computed. MrgsWarning if the scene has a problem that ``mrgs.check`` finds."""
    require_own_threads()
    require_scene(scene)
    with own_modes():
        if not isinstance(scene, Scene):
            scene = load_scene(scene, resolution=config.resolution, seed=config.seed)
        will_compute()
        warn_of_problems(scene)
    return scene


def _response_of(state: TrainingState) -> CameraResponse:
    """What the scene's cameras do to a rendering in host memory, as learned when it is called."""
    image_model = state.image_model
    if state.device == HOST:
        return image_model.expected
    return lambda *seen, **sizes: deepcopy(image_model).to(HOST).expected(*seen, **sizes)
