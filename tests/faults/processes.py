"""Processes that train together under torchrun: killed, asked to stop, short of room."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

from mrgs.training.run_folder import RunFolder
from tests.faults.program import (
    Started,
    ended,
    is_run_left_alone,
    limited_files,
    newest_step,
    small_scene,
    start,
    stopped_after_saving,
    wait_until,
)
from tests.faults.tally import Tally

EVERY = 10
CONFIG = f"checkpoint_every: {EVERY}\n"
LEG = ("--max-steps", 40)
PARAMETERS = ("gaussians.means", "gaussians.log_scales", "gaussians.sh_dc.rgb")
ROUNDING = 1e-3
"""Of parameters, after 20 steps that began alike."""

BEYOND_S = 1.0
"""A kill comes this long after a checkpoint at most."""


def start_torchrun(count: int, *arguments: object, restarts: int = 0, **options: Any) -> Started:
    """Start the program in several processes by torchrun; the options are those of ``Started``."""
    torchrun = (
        "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}",
        f"--max-restarts={restarts}", "-m", "mrgs",
    )  # fmt: skip
    return Started([*torchrun, *arguments], **options)


def kills(folder: Path, count: int, processes: int = 2, seed: int = 0) -> Tally:
    """A training of which a process is killed again and again is, bit by bit, one that is left
    alone, and no kill costs a checkpoint."""
    tally, rng = Tally(), random.Random(seed)
    scene, *options = _options(folder)
    output = folder / "killed"
    arguments = ("train", scene, *options, "--output", output)
    command = start_torchrun(processes, *arguments, restarts=count)
    for number in range(count):
        before = newest_step(output)
        wait_until(lambda before=before: newest_step(output) > before, command)
        time.sleep(rng.uniform(0, BEYOND_S))
        workers, saved = workers_of(command.pid), newest_step(output)
        if len(workers) < processes:
            tally.judge(f"kill {number}", False, f"{len(workers)} processes; {ended(command)}")
            return tally
        rank = rng.randrange(processes)
        os.kill(workers[rank], signal.SIGKILL)
        wait_until(lambda past=set(workers): not past & set(workers_of(command.pid)), command, 100)
        tally.judge(
            f"kill {number} of process {rank}", newest_step(output) >= saved > before, saved
        )
    found = stopped_after_saving(command, output)
    tally.judge("a last checkpoint", "checkpoint saved" in found.out, found)
    is_same = is_run_left_alone(output, scene, folder / "whole")
    tally.judge("the same bits", is_same, "tensors differ")
    tally.judge("nothing left", not list(output.rglob(".mrgs-*")), list(output.rglob(".mrgs-*")))
    tally.figure = f"{processes} processes, {newest_step(output):,} steps"
    return tally


def other_counts(folder: Path) -> Tally:
    """A checkpoint of four processes is continued by one, which gives the same bits, and by two,
    which add up the views in another order."""
    tally = Tally()
    scene, *options = _options(folder)
    source = folder / "four"
    begun = ended(start_torchrun(4, "train", scene, *options, *LEG, "--output", source))
    tally.judge("four processes", newest_step(source) == LEG[1], begun)
    text = (source / "config.yaml").read_text()
    (source / "config.yaml").write_text(text.replace(f"max_steps: {LEG[1]}", "max_steps: 60"))
    models = {}
    for count in (4, 2, 1):
        output = folder / f"by {count}"
        shutil.copytree(source, output)
        arguments = ("train", scene, "--resume", "--output", output)
        process = start(*arguments) if count == 1 else start_torchrun(count, *arguments)
        found = ended(process)
        tally.judge(f"continued by {count}", newest_step(output) == 60, found)
        models[count] = load_file(RunFolder(output).newest_checkpoint())
    names = [name for name in models[4] if models[4][name].is_floating_point()]
    tally.judge("1: the same bits", all(torch.equal(models[1][n], models[4][n]) for n in names))
    away = max(float((models[2][n] - models[4][n]).abs().max()) for n in PARAMETERS)
    tally.judge("2: the same to rounding", away < ROUNDING, away)
    tally.figure = f"2 processes differ by {away:.1g}"
    return tally


def stops(folder: Path, signals: tuple[str, ...] = ("INT", "TERM")) -> Tally:
    """A request to stop that reaches torchrun ends in one checkpoint, from which one process goes
    on."""
    tally = Tally()
    options = _options(folder)
    for name in signals:
        output = folder / f"stopped_{name}"
        command = start_torchrun(2, "train", *options, "--output", output)
        wait_until(lambda output=output: newest_step(output) > 0, command)
        command.send_signal(getattr(signal, f"SIG{name}"))
        found = ended(command)
        said = found.out.count("checkpoint saved; resume with: mrgs train")
        tally.judge(f"SIG{name}", said == 1, found)
    return tally


def full_disk(folder: Path) -> Tally:
    """A checkpoint that cannot be written ends all processes with one line."""
    tally = Tally()
    options = _options(folder)
    command = start_torchrun(
        2, "train", *options, "--output", folder / "full", shell=limited_files(2048)
    )
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


def _options(folder: Path) -> tuple[object, ...]:
    scene, config = small_scene(folder / "scene"), folder / "often.yaml"
    config.write_text(CONFIG)
    small = ("--preset", "fast", "--max-gaussians", 60, "--max-steps", 100_000)
    return scene, *small, "--config", config
