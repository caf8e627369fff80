"""Processes that are killed: what was saved is whole, and the run goes on to the same end."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch
from safetensors.torch import load_file

from mrgs.system.atomic import remove_abandoned
from tests.faults.program import SMALL, environment, run, small_scene, start, wait_until
from tests.faults.tally import Tally

STEPS = 60
SAVE_OFTEN = "checkpoint_every: 3\n"

WRITE = """
import sys
from pathlib import Path
from mrgs.system.atomic import replacing
with replacing(Path(sys.argv[1])) as temporary:
    temporary.write_bytes(bytes(100))
    (temporary.parent / "a library's own").write_bytes(bytes(100))
    print("begun", flush=True)
    sys.stdin.read()
"""
"""Writes a file, and waits for its input to end before the file takes its place."""


def trainings(folder: Path, count: int, seed: int = 0) -> Tally:
    """A training that is killed again and again ends like one that is not."""
    tally, scene, rng = Tally(), small_scene(folder / "scene"), random.Random(seed)
    config = folder / "often.yaml"
    config.write_text(SAVE_OFTEN)
    options = (*SMALL, "--max-steps", STEPS, "--config", config)
    run("train", scene, "--output", folder / "whole", *options)
    output = folder / "killed"
    for number in range(count):
        saved = list((output / "checkpoints").glob("step_*"))
        going_on = ("--resume",) if saved else options
        process = start("train", scene, "--output", output, *going_on)
        wait_until(lambda saved=saved: _newest(output) != _newest_of(saved), process)
        time.sleep(rng.uniform(0, 0.2))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        tally.judge(f"kill {number}", bool(_newest(output)), "no checkpoint is left")
    run("train", scene, "--output", output, "--resume")
    ends = [load_file(_newest(path)) for path in (folder / "whole", output)]
    same = all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])
    tally.judge("the same end", same, "tensors differ")
    tally.judge("nothing left", not list(output.rglob(".mrgs-*")), list(output.rglob(".mrgs-*")))
    return tally


def writes(folder: Path) -> Tally:
    """What a killed process has begun to write goes at the next start; what others write stays."""
    tally = Tally()
    folder.mkdir(parents=True, exist_ok=True)
    dead, alive = (_writing(folder / name) for name in ("dead.bin", "alive.bin"))
    dead.kill()
    dead.communicate()
    remove_abandoned(folder)
    left = len(list(folder.glob(".mrgs-*")))
    tally.judge("temporary files of dead processes", left == 1, f"{left} left, 1 in use")
    alive.communicate("")
    is_whole = (folder / "alive.bin").exists() and os.listdir(folder) == ["alive.bin"]
    tally.judge("temporary files of living processes", is_whole, os.listdir(folder))
    return tally


def _writing(path: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", WRITE, str(path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment(),
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.readline()
    return process


def _newest(output: Path) -> str:
    return _newest_of(list((output / "checkpoints").glob("step_*.safetensors")))


def _newest_of(saved: list[Path]) -> str:
    return str(max(saved)) if saved else ""
