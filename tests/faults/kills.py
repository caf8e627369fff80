"""Processes that are killed: what was saved is whole, and the run goes on to the same end."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from mrgs.system.atomic import remove_abandoned
from tests.faults.program import (
    SMALL,
    Started,
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


SHORT_RUN = """
import sys
from mrgs.app.cli import main
from mrgs.pipeline.plan import QUALITIES, Quality
QUALITIES["fast"] = Quality("fast", "fast", 60, 1500, 320)
sys.exit(main(["run", sys.argv[1], "--quality", "fast", "--yes", *sys.argv[2:]]))
"""
"""``mrgs run`` with a training of seconds."""

TABLETOP = Path(__file__).parents[2] / "examples" / "tabletop"


def pipelines(folder: Path, count: int, seed: int = 0) -> Tally:
    """``mrgs run`` from photos without poses, killed in whatever stage it is in and started again,
    leaves the files of one that is left alone; but for times, memory and the folder's own name."""
    tally, rng = Tally(), random.Random(seed)
    photos = folder / "photos"
    for kind in ("images", "thermal"):
        (photos / kind).mkdir(parents=True)
        for file in sorted((TABLETOP / kind).iterdir())[::3]:
            shutil.copy(file, photos / kind)
    command = "-c", SHORT_RUN, photos, "--bounds", -1, 83, "--output"
    for output, kills in (("whole", 0), ("killed", count)):
        for number in range(kills + 1):
            process = Started([*command, folder / output])
            if number < kills:
                wait_until(lambda: False, process, rng.uniform(5, 60))
                process.send_signal(signal.SIGKILL)
            found = ended(process)
            holds = found.status == 0 or (number < kills and found.status == -signal.SIGKILL)
            tally.judge(f"{output}, {number}", holds, found)
    whole, killed = (_results(folder / output) for output in ("whole", "killed"))
    tally.judge("the same files", whole.keys() == killed.keys(), whole.keys() ^ killed.keys())
    differing = [name for name in whole if whole[name] != killed.get(name)]
    tally.judge("the same content", not differing, differing[:5])
    return tally


def _results(folder: Path) -> dict[str, bytes]:
    """What a pipeline has made, without what it keeps for itself and what has times in it."""
    timed = {"log.jsonl", "metrics.json", "metrics.md", "report.html", "prepare.html"}
    found = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
    return {
        str(name): path.read_bytes()
        for name, path in found.items()
        if len(name.parts) > 1
        and path.name not in timed
        and not {"prepare", "checkpoints"} & {*name.parts}
    }


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
