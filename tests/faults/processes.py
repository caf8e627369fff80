"""Processes that train together under torchrun: killed, asked to stop, short of room."""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch
from safetensors.torch import load_file

from mrgs.method.config import from_yaml
from mrgs.training import train
from mrgs.training.run_folder import RunFolder
from tests.faults.program import ended, environment, small_scene, wait_until
from tests.faults.tally import Tally

EVERY = 10
CONFIG = f"checkpoint_every: {EVERY}\n"
BEYOND_S = 1.0
"""A kill comes this long after a checkpoint at most."""


def start_torchrun(
    count: int, *arguments: object, restarts: int = 0, shell: str = 'exec "$@"'
) -> subprocess.Popen[str]:
    """Start the program in several processes by torchrun."""
    torchrun = (
        "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}",
        f"--max-restarts={restarts}", "-m", "mrgs",
    )  # fmt: skip
    return subprocess.Popen(
        ["sh", "-c", shell, "sh", sys.executable, *torchrun, *map(str, arguments)],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        errors="replace", env=environment(),
    )  # fmt: skip


def kills(folder: Path, count: int, processes: int = 2, seed: int = 0) -> Tally:
    """A training of which a process is killed again and again is, bit by bit, one that is left
    alone, and no kill costs a checkpoint."""
    tally, rng = Tally(), random.Random(seed)
    scene, *options = _options(folder)
    output = folder / "killed"
    arguments = ("train", scene, *options, "--output", output)
    command = start_torchrun(processes, *arguments, restarts=count)
    for number in range(count):
        before = newest(output)
        wait_until(lambda before=before: newest(output) > before, command, 600)
        time.sleep(rng.uniform(0, BEYOND_S))
        workers, saved, rank = workers_of(command.pid), newest(output), rng.randrange(processes)
        os.kill(workers[rank], signal.SIGKILL)
        wait_until(lambda past=set(workers): not past & set(workers_of(command.pid)), command, 100)
        tally.judge(f"kill {number} of process {rank}", newest(output) >= saved > before, saved)
    before = newest(output)
    wait_until(lambda: newest(output) > before, command, 600)
    command.send_signal(signal.SIGTERM)
    found, step = ended(command), newest(output)
    tally.judge("a last checkpoint", "checkpoint saved" in found.out, found)
    whole = train(scene, folder / "whole", RunFolder(output).read_config(from_yaml), stop_at=step)
    ends = [load_file(path) for path in (whole.newest_checkpoint(), _checkpoint(output, step))]
    same = all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])
    tally.judge("the same bits", same, "tensors differ")
    tally.judge("nothing left", not list(output.rglob(".mrgs-*")), list(output.rglob(".mrgs-*")))
    tally.figure = f"{processes} processes, {step:,} steps"
    return tally


def stops(folder: Path, signals: tuple[str, ...] = ("INT", "TERM")) -> Tally:
    """A request to stop that reaches torchrun ends in one checkpoint, from which one process goes
    on."""
    tally = Tally()
    options = _options(folder)
    for name in signals:
        output = folder / f"stopped_{name}"
        command = start_torchrun(2, "train", *options, "--output", output)
        wait_until(lambda output=output: newest(output) > 0, command, 600)
        os.kill(command.pid, getattr(signal, f"SIG{name}"))
        found = ended(command)
        said = found.out.count("checkpoint saved; resume with: mrgs train")
        tally.judge(f"SIG{name}", said == 1, found)
    return tally


def full_disk(folder: Path) -> Tally:
    """A checkpoint that cannot be written ends all processes with one line."""
    tally = Tally()
    options = _options(folder)
    limited = 'ulimit -f 4; exec "$@"'
    command = start_torchrun(2, "train", *options, "--output", folder / "full", shell=limited)
    found = ended(command)
    lines = re.findall(r"^mrgs: error: .*$", found.err, re.MULTILINE)
    one = len(lines) == 1 and "cannot be written" in lines[0]
    tally.judge("a file that cannot grow", one and found.status != 0, lines or found)
    return tally


def workers_of(torchrun: int) -> list[int]:
    """The processes that a torchrun has started, by their numbers."""
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            variables = (path / "environ").read_bytes().split(b"\0")
        except (OSError, IndexError, ValueError):
            continue
        rank = next((each[5:] for each in variables if each.startswith(b"RANK=")), None)
        if parent == torchrun and rank is not None:
            found[int(rank)] = int(path.name)
    return [found[rank] for rank in sorted(found)]


def newest(output: Path) -> int:
    """The step of a run's newest checkpoint; 0 without one."""
    names = [path.stem for path in (output / "checkpoints").glob("step_*.safetensors")]
    return max((int(name.removeprefix("step_")) for name in names), default=0)


def _options(folder: Path) -> tuple[object, ...]:
    scene, config = small_scene(folder / "scene"), folder / "often.yaml"
    config.write_text(CONFIG)
    small = ("--preset", "fast", "--max-gaussians", 60, "--max-steps", 100_000)
    return scene, *small, "--config", config


def _checkpoint(output: Path, step: int) -> Path:
    return output / "checkpoints" / f"step_{step:06d}.safetensors"
