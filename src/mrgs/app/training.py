"""``mrgs train``."""

from __future__ import annotations

import math
import shlex
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mrgs.app.arguments import read_text
from mrgs.app.blocks import require_blocks, train_in_blocks
from mrgs.app.commands import Train
from mrgs.app.interrupts import Interrupted
from mrgs.app.progress import TrainingProgress
from mrgs.app.terminal import note_gpu, print_viewer_address
from mrgs.errors import ConfigError, DeviceError

if TYPE_CHECKING:
    import torch

    from mrgs.runs.registry import Method
    from mrgs.scene import Scene
    from mrgs.training import StepStatistics, TrainConfig
    from mrgs.training.run_folder import RunFolder
    from mrgs.viewer import LiveView


def train(command: Train) -> None:
    """Train.

    Raises:
        MrgsError: what was asked for cannot be done.
        Interrupted: the training was interrupted, and has saved a checkpoint.
    """
    from mrgs.system.gpu import choose_device

    output = _output(command)
    method = _possible_method(command, output)
    device = command.device if method.uses_gpu else "cpu"
    config = _configuration(command, method, device)
    chosen = choose_device(device)
    if command.blocks is not None:
        train_in_blocks(command, output, config, device)
        return
    progress = _progress(command, chosen)
    with progress, _live_view(command, output) as live:
        method.train(
            command.scene,
            output,
            config,
            resume=command.resume,
            accept_changes=command.accept_changes,
            device=device,
            plain=command.plain,
            tensorboard=command.tensorboard,
            **_hooks(progress, live),
        )
    _say_what_next(command, output, progress)


def _possible_method(command: Train, output: Path) -> Method:
    """The method to train with, which can follow the options; of a resumed run, its own.

    Raises:
        ConfigError: it cannot, or they are not those of the resumed run.
        DeviceError: it cannot use a GPU.
    """
    from mrgs.runs.open import method_of
    from mrgs.runs.registry import find_method
    from mrgs.training.run_folder import RunFolder

    goes_on = command.resume and command.blocks is None
    name = method_of(RunFolder(output)).name if goes_on else command.method
    method = find_method(name)
    _require_possible(command, method)
    if goes_on:
        _require_own_settings(command, method, RunFolder(output))
    require_blocks(command)
    return method


def _configuration(command: Train, method: Method, device: str) -> Any:
    """The configuration that the options ask for, with the steps that fit into the minutes."""
    config = _configured(command, method, command.max_steps)
    if command.minutes is None:
        return config
    steps = _steps_in_time(command, method, config, device)
    config = _configured(command, method, steps)
    if config.max_steps != steps:
        raise ConfigError(f"--minutes chooses the steps: leave max_steps out of {command.config}")
    return config


def _configured(command: Train, method: Method, max_steps: int | None) -> Any:
    return method.configure(
        command.preset,
        max_steps=max_steps,
        max_gaussians=command.max_gaussians,
        resolution=command.resolution,
        seed=command.seed,
        batch=command.batch or 1,
        changes="" if command.config is None else read_text(command.config),
        source=str(command.config),
    )


def _steps_in_time(command: Train, method: Method, config: Any, device: str) -> int:
    """Measure how fast the training is here, and say how many steps it gets."""
    from mrgs.pipeline.time_limit import measure_pace, steps_within

    assert command.minutes is not None
    print("measuring the pace of a few steps", flush=True)
    started = time.monotonic()
    pace = measure_pace(method, command.scene, config, device=device, plain=command.plain)
    left_s = command.minutes * 60 - (time.monotonic() - started)
    most = config.densification.max_gaussians if method.has_gaussians else None
    steps = steps_within(left_s, pace, most)
    print(f"{steps:,} steps fit into {command.minutes:g} min", flush=True)
    return steps


def _require_possible(command: Train, method: Method) -> None:
    """Options that the method can follow.

    Raises:
        ConfigError: one needs Gaussians, and there are none.
        DeviceError: the method cannot use a GPU.
    """
    needs = {"--view": command.view, "--max-gaussians": command.max_gaussians}
    for option, value in {**needs, "--batch": command.batch}.items():
        if value and not method.has_gaussians:
            raise ConfigError(
                f"{option} needs a method with Gaussians, and {method.name} has none: leave it out"
            )
    if command.minutes is not None:
        if command.resume or command.max_steps is not None:
            raise ConfigError("--minutes chooses the steps: leave --resume and --max-steps out")
        if not 0 < command.minutes < math.inf:
            raise ConfigError(f"--minutes must be above 0, not {command.minutes:g}")
    if command.accept_changes and not command.resume:
        raise ConfigError("--accept-changes needs --resume: a new run has nothing to compare with")
    if command.device == "cuda" and not method.uses_gpu:
        raise DeviceError(f"{method.name} works on the CPU alone: leave --device out")


def _require_own_settings(command: Train, method: Method, folder: RunFolder) -> None:
    """The options of a resumed run may only repeat the settings that it has.

    Raises:
        ConfigError: some would change them, and would be without effect.
    """
    defaults = {field.name: field.default for field in fields(command)}
    settings = ("method", "preset", *_OWN_SETTINGS, "config")
    given = [name for name in settings if getattr(command, name) != defaults[name]]
    if not given:
        return
    config = folder.read_config(method.read_config)
    own = {name: _setting(config, name) for name in ("method", *_OWN_SETTINGS)}
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


def _setting(config: Any, name: str) -> Any:
    """The value of an option in a run's configuration; None where its method has no such thing."""
    holder = getattr(config, "densification", None) if name == "max_gaussians" else config
    return getattr(holder, name, None)


def _output(command: Train) -> Path:
    """The run's folder."""
    folder = command.scene.parent if command.scene.is_file() else command.scene
    return command.output or Path("runs") / f"{folder.resolve().name}-{command.method}"


def _say_what_next(command: Train, output: Path, progress: TrainingProgress) -> None:
    """How to go on with an unfinished run, or what to do with a finished one."""
    if progress.unfinished:
        go_on = shlex.join(
            ["mrgs", "train", str(command.scene), "--output", str(output), "--resume"]
        )
        print(f"checkpoint saved; resume with: {go_on}", file=progress.sink)
        raise Interrupted
    if command.resume and not progress.has_stepped:
        print(f"already finished at step {progress.max_steps:,}")
    quoted = shlex.quote(str(output))
    print(f"run:  {output}\nnext: mrgs eval {quoted}\n      mrgs render {quoted}")


def _progress(command: Train, device: torch.device) -> TrainingProgress:
    """The terminal's line, below the name of the GPU if one is used."""
    from mrgs.system.gpu import HOST

    note_gpu(device)
    return TrainingProgress(compiles=device == HOST and not command.plain)


def _live_view(command: Train, output: Path) -> LiveView | AbstractContextManager[None]:
    """The view of the training, if it is asked for."""
    if not command.view:
        return nullcontext()

    from mrgs.viewer import LiveView

    return LiveView(output, port=command.port, on_ready=print_viewer_address)


def _hooks(progress: TrainingProgress, live: LiveView | None) -> dict[str, Any]:
    """What ``train`` calls: the terminal's line, and the view if there is one."""
    if live is None:
        return {"on_start": progress.start, "on_step": progress.step}

    def on_start(scene: Scene, config: TrainConfig) -> None:
        progress.start(scene, config)
        live.on_start(scene, config)

    def on_step(statistics: StepStatistics) -> bool:
        live.on_step(statistics)
        return progress.step(statistics)

    return {"on_start": on_start, "on_model": live.on_model, "on_step": on_step}
