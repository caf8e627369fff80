"""Blocks of a scene that are killed, asked to stop, or have no room."""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from safetensors.torch import load_file

from mrgs.run_files.folder import RunFolder
from tests.faults.program import Started, ended, newest_step, run, small_scene, start, wait_until
from tests.faults.tally import Tally

EVERY, STEPS = 20, 300
CONFIG = f"checkpoint_every: {EVERY}\n"
LATEST_S = 8.0
"""A run is ended at most so long after it has begun to work: by then much of it is done."""

ROOM = 60_000
"""Bytes of the disk of one block: more than its configuration, less than two checkpoints."""


def kills(folder: Path, count: int, seed: int = 0) -> Tally:
    """Blocks that one process trains, and that are ended again and again, at any moment and by any
    signal, become bit by bit the model of blocks that are left alone."""
    tally, rng = Tally(), random.Random(seed)
    arguments, output = _arguments(folder), folder / "killed"
    expected = _whole(folder, arguments)
    left = count
    while left or not _is_finished(output):
        _compared(tally, output, expected)
        saved = _saved(output)
        process = start(*arguments, "--output", output)
        name = rng.choice(("KILL", "KILL", "TERM", "INT"))
        if left and _alive_at(rng.uniform(0, LATEST_S), process, output):
            process.send_signal(getattr(signal, f"SIG{name}"))
            left -= 1
            found = ended(process)
            holds = found.is_clean or name == "KILL"
        else:
            found = ended(process)
            holds = found.status == 0
        tally.judge(f"SIG{name}, {left} left", holds and _is_kept(saved, output), found)
    _compared(tally, output, expected)
    tally.judge("nothing left", not list(folder.rglob(".mrgs-*")), list(folder.rglob(".mrgs-*")))
    return tally


def full_disk(folder: Path) -> Tally:
    """A block whose disk is full is named in one line; with more room the same command ends with
    the bits of blocks that had it. Needs the right to mount."""
    tally = Tally()
    arguments = _arguments(folder)
    expected, output = _whole(folder, arguments), folder / "full"
    with _disk(output / "blocks/002", ROOM):
        found = run(*arguments, "--output", output)
        lines = [line for line in found.err.splitlines() if line.startswith("mrgs: error: ")]
        one = len(lines) == 1 and "blocks/002" in lines[0] and "cannot be written" in lines[0]
        tally.judge("one line", one and found.status != 0, lines or found)
        tally.judge("the block before it", _saved(output)["001"] == STEPS, _saved(output))
        saved = _saved(output)
        _resize(output / "blocks/002", 1000 * ROOM)
        found = run(*arguments, "--output", output)
        same = found.status == 0 and _tensors(output) == expected
        tally.judge("the same bits with more room", same and _is_kept(saved, output), found)
    return tally


def _arguments(folder: Path) -> tuple[object, ...]:
    scene, config = small_scene(folder / "scene"), folder / "often.yaml"
    config.write_text(CONFIG)
    small = ("--preset", "fast", "--max-gaussians", 60, "--max-steps", STEPS)
    return "train", scene, "--blocks", "2x2", "--overlap", 0.1, *small, "--config", config


def _whole(folder: Path, arguments: tuple[object, ...]) -> Mapping[str, bytes]:
    """The model of blocks that nothing disturbs."""
    found = run(*arguments, "--output", folder / "whole")
    assert found.status == 0, found
    return _tensors(folder / "whole")


def _tensors(output: Path) -> Mapping[str, bytes]:
    """The bits of the joined model."""
    tensors = load_file(RunFolder(output).newest_checkpoint())
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}


def _is_finished(output: Path) -> bool:
    return newest_step(output) > 0


def _compared(tally: Tally, output: Path, expected: Mapping[str, bytes]) -> None:
    """Compare a finished run, and remove it."""
    if _is_finished(output):
        tally.judge("the same bits", _tensors(output) == expected)
        shutil.rmtree(output)


def _saved(output: Path) -> dict[str, int]:
    """The newest step of each run of the blocks."""
    return {path.name: newest_step(path) for path in (output / "blocks").glob("*/")}


def _is_kept(saved: Mapping[str, int], output: Path) -> bool:
    """Whether every run is at least where it was."""
    return all(_saved(output).get(name, 0) >= step for name, step in saved.items())


def _alive_at(seconds: float, process: Started, output: Path) -> bool:
    """Wait so long after a run has begun to work; whether it still does."""
    wait_until((output / "blocks").exists, process)
    end = time.monotonic() + seconds
    wait_until(lambda: time.monotonic() > end, process)
    return process.poll() is None


@contextmanager
def _disk(folder: Path, room: int) -> Iterator[None]:
    """A disk of its own at a folder."""
    folder.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={room}", "tmpfs", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def _resize(disk: Path, room: int) -> None:
    subprocess.run(["mount", "-o", f"remount,size={room}", disk], check=True)
