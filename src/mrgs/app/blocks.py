"""``mrgs train --blocks``."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mrgs.app.commands import Train
from mrgs.app.interrupts import Interrupted
from mrgs.app.progress import TrainingProgress
from mrgs.errors import ConfigError

if TYPE_CHECKING:
    from mrgs.system.gpu import DeviceName


def require_blocks(command: Train) -> None:
    """Options that go together with blocks, and those that do not.

    Raises:
        ConfigError: one that does not.
    """
    if command.blocks is None:
        if command.overlap is not None or command.block is not None:
            raise ConfigError("--overlap and --block need --blocks: give --blocks auto")
        return
    for option, value in {
        "--view": command.view,
        "--tensorboard": command.tensorboard,
        "--minutes": command.minutes is not None,
        "--accept-changes": command.accept_changes,
        "--batch": command.batch not in (None, 1),
    }.items():
        if value:
            raise ConfigError(f"{option} does not work with --blocks: leave it out")


def train_in_blocks(command: Train, output: Path, config: Any, device: DeviceName) -> None:
    """Train what is left, and join the blocks if all are finished."""
    from mrgs.blocks.plan import BlockOptions
    from mrgs.blocks.train import BlockTraining
    from mrgs.data import load_scene
    from mrgs.method.config import TrainConfig
    from mrgs.runs.registry import Method, find_method
    from mrgs.training.run_folder import RunFolder

    assert command.blocks is not None
    if not isinstance(config, TrainConfig) or find_method(command.method).train is not Method.train:
        raise ConfigError(f"{command.method} cannot be trained in blocks: leave --blocks out")
    training = BlockTraining(
        load_scene(command.scene, resolution=config.resolution, seed=config.seed),
        RunFolder(output),
        config,
        BlockOptions(command.blocks, command.overlap),
        device,
        command.plain,
        _follow,
        lambda line: print(line, flush=True),
    )
    if command.block is None:
        training.train_all()
    else:
        training.train_block(command.block)
    _say_what_next(command, output, training.unfinished())


@contextmanager
def _follow(title: str) -> Iterator[Mapping[str, Any]]:
    """Show a training; ends the command if it was interrupted."""
    print(f"{title}:", flush=True)
    progress = TrainingProgress()
    with progress:
        yield {"on_start": progress.start, "on_step": progress.step}
    if progress.unfinished:
        print("checkpoint saved; re-run the same command to resume", file=progress.sink)
        raise Interrupted


def _say_what_next(command: Train, output: Path, left: list[int]) -> None:
    quoted = shlex.quote(str(output))
    if left:
        numbers = ", ".join(map(str, left))
        print(f"blocks left: {numbers}; they are joined by the same command without --block")
    elif command.block is not None:
        print("no block is left; join them by the same command without --block")
    else:
        print(f"run:  {output}\nnext: mrgs eval {quoted}\n      mrgs export {quoted}")
