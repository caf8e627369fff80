"""Runs side by side, each in a process of its own.

Its memory is given back when it ends, and a run that crashes takes no other with it. The processes
are started with an
argv: ``multiprocessing`` would pickle what it hands over and run the caller's script again in each
    of them.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mrgs.comparison.methods import to_text
from mrgs.comparison.plan import Job
from mrgs.system.gpu import DeviceName
from mrgs.system.isolation import CHILD_FOLDER, child_environment

CHILD = ("-m", "mrgs.comparison.child")
TICK_S = 1.0

Message = dict[str, Any]
"""What a child says, see ``mrgs.comparison.child``."""


@dataclass(eq=False)
class _Child:
    job: Job
    process: subprocess.Popen[str]
    errors: Path
    end: Message = field(default_factory=dict)


def run_jobs(
    jobs: Sequence[Job],
    count: int,
    lpips_weights: Path | None,
    on_message: Callable[[Job, Message], None],
    on_tick: Callable[[], None],
    device: DeviceName = "auto",
) -> dict[Job, str]:
    """Do all jobs, ``count`` at a time.

    Args:
        jobs: in the order in which they are started.
        count: how many processes at a time; the machine's cores are divided among as many as there
            can be.
        lpips_weights: weights for LPIPS.
        on_message: called with what a child says, and with ``{"start": True}`` when it is started.
        on_tick: called about once a second.
        device: where they train and render.

    Returns:
        of each job that failed, why: one line.

    Raises:
        KeyboardInterrupt: Ctrl-C; the running jobs have left checkpoints. A second one ends them at
            once.
    """
    waiting, running, failures = list(jobs), list[_Child](), dict[Job, str]()
    inbox: queue.Queue[tuple[_Child, Message | None]] = queue.Queue()
    try:
        while waiting or running:
            while waiting and len(running) < count:
                job = waiting.pop(0)
                running.append(
                    _start(job, threads_each(min(count, len(jobs))), device, lpips_weights, inbox)
                )
                on_message(job, {"start": True})
            _receive(inbox, running, failures, on_message)
            on_tick()
    except KeyboardInterrupt:
        for child in running:
            _close_input(child)
        while running:
            _receive(inbox, running, failures, on_message)
        raise
    finally:
        for child in running:  # something went wrong here, or a second Ctrl-C
            child.process.kill()
            child.process.wait()
    return failures


def threads_each(count: int) -> int:
    """The threads of one of ``count`` processes."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    return max(1, cores // count)


def _start(
    job: Job,
    threads: int,
    device: DeviceName,
    lpips_weights: Path | None,
    inbox: queue.Queue[tuple[_Child, Message | None]],
) -> _Child:
    request = {
        "scene": str(job.scene.absolute()),  # the child runs in another folder
        "folder": str(job.folder.absolute()),
        "config": to_text(job.config),
        "device": device,
        "lpips_weights": None if lpips_weights is None else str(lpips_weights.absolute()),
    }
    # Threads that spin while they wait would starve those of the other processes.
    limits = {
        "OMP_NUM_THREADS": str(threads),
        "NUMBA_NUM_THREADS": str(threads),
        "OMP_WAIT_POLICY": "PASSIVE",
    }
    errors = job.folder.parent / f"{job.folder.name}.stderr.txt"
    errors.parent.mkdir(parents=True, exist_ok=True)
    with errors.open("w", encoding="utf-8") as file:
        process = subprocess.Popen(
            [sys.executable, *CHILD, json.dumps(request)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=file,
            text=True,
            encoding="utf-8",
            env=child_environment(**limits),
            cwd=CHILD_FOLDER,
            start_new_session=True,  # Ctrl-C is for this process alone
        )
    child = _Child(job, process, errors)
    threading.Thread(target=_listen, args=(child, inbox), daemon=True).start()
    return child


def _listen(child: _Child, inbox: queue.Queue[tuple[_Child, Message | None]]) -> None:
    """Put what the child says into the inbox, and None when it has ended."""
    assert child.process.stdout is not None
    with child.process.stdout as lines:
        for line in lines:
            try:
                message = json.loads(line)
            except ValueError:  # a library that prints
                continue
            if isinstance(message, dict):
                inbox.put((child, message))
    child.process.wait()
    inbox.put((child, None))


def _receive(
    inbox: queue.Queue[tuple[_Child, Message | None]],
    running: list[_Child],
    failures: dict[Job, str],
    on_message: Callable[[Job, Message], None],
) -> None:
    """Handle one message, or let a tick pass."""
    try:
        child, message = inbox.get(timeout=TICK_S)
    except queue.Empty:
        return
    if message is not None:
        child.end = message if "end" in message else child.end
        if "end" not in message:
            on_message(child.job, message)
        return
    running.remove(child)
    _close_input(child)
    reason = _failure(child)
    if reason is None:
        child.errors.unlink(missing_ok=True)
    else:
        failures[child.job] = reason
    on_message(child.job, child.end if reason is None else {"end": "error", "message": reason})


def _failure(child: _Child) -> str | None:
    """Why the child did not do its work; None if it did, or was asked to stop."""
    status = child.process.returncode
    if status == 0 and child.end.get("end") in ("scored", "stopped"):
        return None
    if child.end.get("end") == "error":
        child.errors.unlink(missing_ok=True)
        return str(child.end["message"])
    if status == -9:
        return (
            "the system ended the process (signal 9), most likely for want of memory: use "
            "fewer --jobs"
        )
    lines = child.errors.read_text(encoding="utf-8", errors="replace").strip().splitlines() or [
        "no message"
    ]
    return f"the process ended with status {status} ({lines[-1]}); see {child.errors}"


def _close_input(child: _Child) -> None:
    """Ask the child to stop."""
    assert child.process.stdin is not None
    child.process.stdin.close()
