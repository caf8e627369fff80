"""``mrgs train``."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mrgs.app.commands import Train
from mrgs.app.interrupts import Interrupted
from mrgs.app.progress import TrainingProgress
from mrgs.app.terminal import note_gpu, print_viewer_address, read_text, say
from mrgs.errors import ConfigError, DeviceError
from mrgs.system.wording import quoted

if TYPE_CHECKING:
    from mrgs.run_files.folder import RunFolder
    from mrgs.runs.registry import Method
    from mrgs.scene import Scene
    from mrgs.system.gpu import DeviceName
    from mrgs.training import Hooks, StepStatistics, TrainConfig


def train(command: Train) -> None:
    """Train. MrgsError if an option cannot be followed, or as the training; Interrupted if the
    training was interrupted, and has saved a checkpoint."""
    from mrgs.run_files.folder import RunFolder
    from mrgs.runs.open import method_of
    from mrgs.runs.registry import find_method
    from mrgs.system.gpu import choose_device
    from mrgs.training.loop import Validation
    from mrgs.training.start import Hooks, TrainOptions

    scene = command.scene.parent if command.scene.is_file() else command.scene
    output = command.output or Path("runs") / f"{scene.resolve().name}-{command.method}"
    folder, resumes = RunFolder(output), command.resume and command.blocks is None
    method = find_method(method_of(folder).name if resumes else command.method)
    _require_possible(command, method)
    if resumes:
        _require_own_settings(command, method, folder)
    device = command.device if method.uses_gpu else "cpu"
    config = _configured(command, method, command.max_steps)
    if command.minutes is not None:
        config = _within_minutes(command, method, config, device)
    chosen = choose_device(device)
    if command.blocks is not None:
        _train_in_blocks(command, folder, config, device)
        return
    note_gpu(chosen)
    progress = TrainingProgress()
    hooks = Hooks(progress.step, progress.start)
    if command.eval_steps is not None:
        from mrgs.evaluation.score_run import score_during_training as score

        hooks = replace(hooks, validation=Validation(command.eval_steps, progress.paused()(score)))
    with progress, ExitStack() as stack:
        if command.view:
            from mrgs.viewer import LiveView

            view = LiveView(output, port=command.port, on_ready=print_viewer_address)
            live = stack.enter_context(view)

            def on_start(scene: Scene, config: TrainConfig) -> None:
                progress.start(scene, config)
                live.on_start(scene, config)

            def on_step(statistics: StepStatistics) -> bool:
                live.on_step(statistics)
                return progress.step(statistics)

            hooks = replace(hooks, on_step=on_step, on_start=on_start, on_model=live.on_model)
        method.train(
            command.scene,
            output,
            config,
            TrainOptions(
                command.resume, command.accept_changes, device, command.plain, command.tensorboard
            ),
            hooks,
        )
    _print_next(command, output, progress)


def _require_possible(command: Train, method: Method) -> None:
    """Check the options against each other and the method."""
    gaussian_options = {
        "--view": command.view, "--max-gaussians": command.max_gaussians,
        "--batch": command.batch, "--eval-steps": command.eval_steps,
    }  # fmt: skip
    for option, value in gaussian_options.items():
        if value and not method.has_gaussians:
            raise ConfigError(
                f"{option} needs a method with Gaussians, and {method.name} has none: leave it out"
            )
    if command.minutes is not None:
        if command.resume or command.max_steps is not None:
            raise ConfigError("--minutes chooses the steps: leave --resume and --max-steps out")
        if command.eval_steps is not None:  # how long it takes is known only once it is done
            raise ConfigError(
                "--minutes does not allow for the time of scoring: leave --eval-steps out, or give "
                "--max-steps instead of --minutes"
            )
        if not 0 < command.minutes < math.inf:
            raise ConfigError(f"--minutes must be above 0, not {command.minutes:g}")
    if command.flat_field is not None and command.resume:
        raise ConfigError("a resumed run keeps its shading: leave --flat-field out")
    if command.flat_field_unit is not None and command.flat_field is None:
        raise ConfigError("--flat-field-unit needs --flat-field: it is the unit of its files")
    if command.accept_changes and not command.resume:
        raise ConfigError("--accept-changes needs --resume: a new run has nothing to compare with")
    if command.device == "cuda" and not method.uses_gpu:
        raise DeviceError(f"{method.name} works on the CPU alone: leave --device out")
    if command.blocks is None:
        if command.overlap is not None or command.block is not None:
            raise ConfigError("--overlap and --block need --blocks: give --blocks auto")
        return
    for option, value in {
        "--view": command.view,
        "--tensorboard": command.tensorboard,
        "--eval-steps": command.eval_steps is not None,
        "--minutes": command.minutes is not None,
        "--accept-changes": command.accept_changes,
        "--batch": command.batch not in (None, 1),
    }.items():
        if value:
            raise ConfigError(f"{option} does not work with --blocks: leave it out")


def _configured(command: Train, method: Method, max_steps: int | None) -> Any:
    config = method.configure(
        command.preset,
        max_steps=max_steps,
        max_gaussians=command.max_gaussians,
        resolution=command.resolution,
        seed=command.seed,
        batch=command.batch or 1,
        changes="" if command.config is None else read_text(command.config),
        source=str(command.config),
    )
    if command.flat_field is None:
        return config
    from mrgs.method.config import TrainConfig, with_flat_field

    if not isinstance(config, TrainConfig):
        raise ConfigError(f"--flat-field does not work with {method.name}: leave it out")
    return with_flat_field(config, command.flat_field, command.flat_field_unit)


def _within_minutes(command: Train, method: Method, config: Any, device: DeviceName) -> Any:
    """The configuration with the steps that fit into ``--minutes``, at the pace measured here."""
    from mrgs.pipeline.forecast import measure_pace, steps_within
    from mrgs.training.start import TrainOptions

    assert command.minutes is not None
    print("measuring the pace of a few steps", flush=True)
    started = time.monotonic()
    options = TrainOptions(device=device, plain=command.plain)
    pace = measure_pace(method, command.scene, config, options)
    left_s = command.minutes * 60 - (time.monotonic() - started)
    most = config.densification.max_gaussians if method.has_gaussians else None
    steps = steps_within(left_s, pace, most)
    print(f"{steps:,} steps fit into {command.minutes:g} min", flush=True)
    config = _configured(command, method, steps)
    if config.max_steps != steps:
        raise ConfigError(f"--minutes chooses the steps: leave max_steps out of {command.config}")
    return config


def _require_own_settings(command: Train, method: Method, folder: RunFolder) -> None:
    """Check that the options of a resumed run only repeat its settings."""
    defaults = {field.name: field.default for field in fields(command)}
    settings = ("method", "preset", *_OWN_SETTINGS, "config")
    given = [name for name in settings if getattr(command, name) != defaults[name]]
    if not given:
        return
    config = folder.read_config(method.read_config)
    values = {"max_gaussians": getattr(config, "densification", None)}
    own: dict[str, Any] = {
        name: getattr(values.get(name, config), name, None) for name in ("method", *_OWN_SETTINGS)
    }
    other = [name for name in given if name in own and getattr(command, name) != own[name]]
    if not other:
        asked = method.configure(
            command.preset,
            **{name: own[name] for name in _OWN_SETTINGS if own[name] is not None},
            changes="" if command.config is None else read_text(command.config),
            source=str(command.config),
        )
        other = [name for name in given if name not in own and asked != config]
    if other:
        raise ConfigError(
            f"{folder.path} is resumed with the settings that it was started with, and these "
            f"options ask for others: leave them out, or train a new run in another folder",
            options=(*other, "output"),
        )


_OWN_SETTINGS = ("max_steps", "max_gaussians", "resolution", "seed", "batch")
"""Options with a value of their own in a run's configuration."""


def _print_next(command: Train, output: Path, progress: TrainingProgress) -> None:
    """Print how to resume an unfinished run, or what to do with a finished one."""
    if progress.unfinished:
        go_on = f"mrgs train {quoted(command.scene)} --output {quoted(output)} --resume"
        print(f"checkpoint saved; resume with: {go_on}", file=progress.sink)
        raise Interrupted
    if command.resume and not progress.has_stepped:
        print(f"already finished at step {progress.max_steps:,}")
    run = quoted(output)
    say(f"run:  {output}", f"next: mrgs eval {run}", f"      mrgs render {run}")


def _train_in_blocks(command: Train, folder: RunFolder, config: Any, device: DeviceName) -> None:
    """Train what is left, and join the blocks if all are finished."""
    from mrgs.blocks.plan import BlockOptions
    from mrgs.blocks.train import BlockTraining
    from mrgs.data import load_scene
    from mrgs.method.config import TrainConfig
    from mrgs.runs.registry import Method, find_method

    assert command.blocks is not None
    if not isinstance(config, TrainConfig) or find_method(command.method).train is not Method.train:
        raise ConfigError(f"{command.method} cannot be trained in blocks: leave --blocks out")
    training = BlockTraining(
        load_scene(command.scene, resolution=config.resolution, seed=config.seed),
        folder,
        config,
        BlockOptions(command.blocks, command.overlap),
        device,
        command.plain,
        _follow_block,
        lambda line: print(line, flush=True),
    )
    if command.block is None:
        training.train_all()
    else:
        training.train_block(command.block)
    run = quoted(folder.path)
    if left := training.unfinished():
        numbers = ", ".join(map(str, left))
        print(f"blocks left: {numbers}; they are joined by the same command without --block")
    elif command.block is not None:
        print("all blocks are trained; run again without --block to join them")
    else:
        say(f"run:  {folder.path}", f"next: mrgs eval {run}", f"      mrgs export {run}")


@contextmanager
def _follow_block(title: str) -> Iterator[Hooks]:
    """Show a training; ends the command if it was interrupted."""
    from mrgs.training.start import Hooks

    print(f"{title}:", flush=True)
    progress = TrainingProgress()
    with progress:
        yield Hooks(progress.step, progress.start)
    if progress.unfinished:
        print("checkpoint saved; re-run the same command to resume", file=progress.sink)
        raise Interrupted
