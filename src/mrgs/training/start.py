"""How a training of any method begins: the run's folder is locked, the scene read, and the state
made or loaded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from mrgs.check import warn_of_problems
from mrgs.data import load_scene
from mrgs.scene import Scene
from mrgs.system.operation import plainly
from mrgs.system.threads import require_own_threads, will_compute
from mrgs.system.torch_modes import own_modes
from mrgs.training.checkpoint import load_facts
from mrgs.training.facts import CheckpointFacts, facts_to_resume, require_scene
from mrgs.training.newest import load_newest
from mrgs.training.run_folder import RunConfig, RunFolder
from mrgs.training.tensorboard import tensorboard_log

C = TypeVar("C", bound=RunConfig)
S = TypeVar("S")


@dataclass(frozen=True)
class TrainingStart(Generic[C, S]):
    """The folder, scene, configuration and state that a training starts from.

    Attributes:
        folder: the run's folder, locked.
        facts: of the checkpoint that is continued, or of step 0.
        scene: at the run's resolution.
        config: in force.
        state: all that changes during training.
    """

    folder: RunFolder
    facts: CheckpointFacts
    scene: Scene
    config: C
    state: S


@contextmanager
def start_training(
    scene: Scene | str | Path,
    output: str | Path,
    config: C,
    *,
    resume: bool,
    accept_changes: bool,
    plain: bool,
    tensorboard: bool,
    on_start: Callable[[Scene, C], None] | None = None,
    read_config: Callable[[RunFolder], C],
    initial_state: Callable[[Scene, C], S],
    load_state: Callable[[Path, C], S],
) -> Iterator[TrainingStart[C, S]]:
    """Within this block the run's folder is locked, and no other process trains in it.

    Args:
        scene: the scene or its folder; one that was read before keeps its resolution.
        output: the run's folder; must not hold a run unless ``resume``.
        config: what to train; a resumed run keeps its own.
        resume: continue the run from its newest checkpoint that is whole.
        accept_changes: resume where photos, poses or intrinsics have changed.
        plain: run the plain definitions of all operations instead of kernels.
        tensorboard: also write the log to the run's folder ``tensorboard``.
        on_start: called with the scene and the configuration in force, before the state is made.
        read_config: the configuration of the run that is continued.
        initial_state: the state at step 0.
        load_state: the state in a checkpoint.

    Warns:
        MrgsWarning: the scene has a problem that ``mrgs.check`` finds, or has changed,
            and that is accepted; or the newest checkpoint is damaged, and an older one is used.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used, or the scene has changed.
        ConfigError: TensorBoard was asked for and is not installed, or torch's default type is not
            float32.
        MrgsError: this process was forked from one that has computed.
    """
    require_own_threads()
    require_scene(scene)
    folder = RunFolder(output)
    config = _config_in_force(folder, config, resume, read_config)
    if isinstance(scene, Scene) and not resume:
        config = replace(cast(Any, config), resolution=scene.resolution)
    with own_modes():
        loaded = (
            scene
            if isinstance(scene, Scene)
            else load_scene(scene, resolution=config.resolution, seed=config.seed)
        )
    will_compute()
    warn_of_problems(loaded)
    with folder.training(config, resume), plainly(plain):
        if on_start is not None:
            on_start(loaded, config)
        with own_modes():
            if resume:
                state, facts = load_newest(
                    folder,
                    lambda path: (load_state(path, config), load_facts(path)),
                    set_aside=True,
                )
                facts = facts_to_resume(facts, loaded, accept_changes)
                folder.cut_log(facts.step)
            else:
                facts = CheckpointFacts.at_start(loaded)
                state = initial_state(loaded, config)
        with tensorboard_log(folder, facts.step) if tensorboard else nullcontext():
            yield TrainingStart(folder, facts, loaded, config, state)


def _config_in_force(
    folder: RunFolder, config: C, resume: bool, read_config: Callable[[RunFolder], C]
) -> C:
    """The configuration of a new run, or of the one that is continued.

    Raises:
        RunError: the folder cannot be used for it.
    """
    if not resume:
        folder.require_new()
        return config
    folder.newest_checkpoint()
    config = read_config(folder)
    folder.warn_if_incomplete(config)
    return config
