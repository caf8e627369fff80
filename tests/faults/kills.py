"""Processes that are killed: what was saved is whole, and the run goes on to the same end."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from mrgs.system.atomic import remove_abandoned
from tests.faults.program import (
    SMALL,
    ended,
    environment,
    is_run_left_alone,
    newest_step,
    small_scene,
    start,
    stopped_after_saving,
    wait_until,
)
from tests.faults.tally import Tally

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
    """A training that is killed again and again is, bit by bit, one that is left alone."""
    tally, scene, rng = Tally(), small_scene(folder / "scene"), random.Random(seed)
    config, output = folder / "often.yaml", folder / "killed"
    config.write_text(SAVE_OFTEN)
    options = ("train", scene, *SMALL, "--max-steps", 100_000, "--config", config)
    resume = ("train", scene, "--resume", "--output", output)
    for number in range(count):
        before = newest_step(output)
        process = start(*resume) if before else start(*options, "--output", output)
        wait_until(lambda before=before: newest_step(output) > before, process)
        time.sleep(rng.uniform(0, 0.2))
        process.send_signal(signal.SIGKILL)
        found = ended(process)
        holds = found.status == -signal.SIGKILL and newest_step(output) > before
        tally.judge(f"kill {number}", holds, f"{found}, no step after {before} was kept")
    last = stopped_after_saving(start(*resume), output)
    is_same = is_run_left_alone(output, scene, folder / "whole")
    tally.judge("the same bits", is_same, f"tensors differ; {last}")
    tally.judge("nothing left", not list(output.rglob(".mrgs-*")), list(output.rglob(".mrgs-*")))
    tally.figure = f"{newest_step(output):,} steps"
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
