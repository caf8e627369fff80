"""Signals, and outputs that cannot be written: no step is lost, and one line says what happened."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path

from tests.faults.program import (
    SMALL,
    Started,
    ended,
    logged_step,
    photos_of,
    run,
    small_scene,
    start,
    wait_until,
)  # fmt: skip
from tests.faults.tally import Tally

SIGNALS = ("INT", "TERM", "HUP")
STEPS = ("--max-steps", 100_000)
ENDLESS = ("--method", "3dgs-rgbt", *STEPS)
"""The method that begins soonest."""


def trainings(folder: Path, signals: Sequence[str]) -> Tally:
    """A training that is asked to stop leaves a checkpoint of the step that it was at."""
    tally, scene = Tally(), small_scene(folder / "scene")
    for name in signals:
        output = folder / f"train_{name}_{len(list(folder.iterdir()))}"
        process = start("train", scene, "--output", output, *SMALL, *ENDLESS)
        wait_until(lambda output=output: logged_step(output) >= 10, process)
        process.send_signal(getattr(signal, f"SIG{name}"))
        found = ended(process)
        saved = list((output / "checkpoints").glob("step_*"))
        expected = 128 + getattr(signal, f"SIG{name}")
        holds = found.is_clean and found.status == expected and len(saved) == 1
        tally.judge(f"train, SIG{name}", holds and "resume with" in found.out, found)
    return tally


def imports(folder: Path, moments_s: Sequence[float]) -> Tally:
    """Ctrl-C while the program is loaded, after some processor seconds, is one line."""
    tally, scene = Tally(), small_scene(folder / "scene")
    for moment in moments_s:
        output = folder / f"after {moment} s"
        process = start("train", scene, "--output", output, *SMALL, *ENDLESS)
        wait_until(lambda moment=moment, at=process.pid: _processor_s(at) >= moment, process)
        process.send_signal(signal.SIGINT)
        found = ended(process)
        holds = found.is_clean and found.status == 130
        said = "mrgs: stopped" in found.err or "resume with" in found.out
        tally.judge(f"Ctrl-C after {moment} s", holds and said, found)
    return tally


def comparisons(folder: Path, signals: Sequence[str]) -> Tally:
    """A comparison that ends, however it ends, takes its runs with it, which leave checkpoints."""
    tally, scene = Tally(), small_scene(folder / "scene")
    for name in signals:
        output = folder / f"compare_{name}"
        methods = ("--methods", "3dgs-rgbt", *SMALL, *STEPS)
        process = start("compare", scene, *methods, "--output", output)

        def is_training(output: Path = output) -> bool:
            return any(logged_step(path.parent) >= 10 for path in output.rglob("log.jsonl"))

        wait_until(is_training, process)
        process.send_signal(getattr(signal, f"SIG{name}"))
        found = ended(process)
        end = time.monotonic() + 60
        while (left := _processes_of(output)) and time.monotonic() < end:
            time.sleep(0.2)
        saved = list(output.rglob("step_*.safetensors"))
        holds = not left and bool(saved) and (name == "KILL" or found.is_clean)
        tally.judge(f"compare, SIG{name}", holds, f"{found}, processes left: {left}")
    return tally


def preparations(folder: Path, shares: Sequence[float], number: int = signal.SIGTERM) -> Tally:
    """A preparation that was ended at any moment goes on with the same command; moments are shares
    of the processor time that one takes which nothing ends. One that is done by then does not
    count."""
    tally, scene = Tally(), small_scene(folder / "scene")
    options = photos_of(scene, folder / "photos")
    whole_s = _processor_s_of(start("prepare", options[0], folder / "whole", *options[1:]))
    expected = -number if number == signal.SIGKILL else 128 + number
    for place, share in enumerate(shares):
        made = folder / f"prepared_{number}_{place}"
        process = start("prepare", options[0], made, *options[1:])
        wait_until(lambda at=process.pid, s=share * whole_s: _processor_s(at) >= s, process)
        process.send_signal(number)
        first, again = ended(process), run("prepare", options[0], made, *options[1:])
        if "next:" in first.out:
            continue
        left = [path.name for path in made.rglob(".mrgs-*")]
        holds = first.status == expected and again.status == 0 and not left
        seen = f"{first}; {again}; left: {left}"
        tally.judge(f"prepare, ended at {100 * share:.0f} %", holds, seen)
    return tally


OUTPUTS = {
    "closed output": 'exec "$@" >&-',
    "full output": 'exec "$@" >/dev/full',
    "closed pipe": '"$@" | head -c 1',
    "closed error output": 'exec "$@" 2>&-',
    "no stream at all": 'exec "$@" <&- >&- 2>&-',
}


def outputs(folder: Path, names: Sequence[str] = tuple(OUTPUTS)) -> Tally:
    """An output that cannot be written ends a training with a checkpoint."""
    tally, scene = Tally(), small_scene(folder / "scene")
    for name in names:
        output = folder / f"output {name}"
        steps = ("--max-steps", 30)
        found = run("train", scene, "--output", output, *SMALL, *steps, shell=OUTPUTS[name])
        saved = list((output / "checkpoints").glob("step_*"))
        tally.judge(f"train, {name}", found.is_clean and len(saved) == 1, found)
    return tally


def _processes_of(folder: Path) -> list[str]:
    """Processes whose command line names a folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            command = path.read_bytes()
        except OSError:
            continue
        if b"mrgs_compare.child" in command and os.fsencode(folder) in command:
            found.append(path.parent.name)
    return found


def _processor_s_of(process: Started) -> float:
    """Processor time that a process takes until its end."""
    found = 0.0
    while process.poll() is None:
        found = _processor_s(process.pid)
        time.sleep(0.02)
    ended(process)
    return found


def _processor_s(pid: int) -> float:
    """Processor time that a process has taken, which does not depend on what else is running."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
