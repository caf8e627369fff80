"""Runs side by side, each in a process of its own.

Its memory is given back when it ends, and a run that crashes takes no other with it.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mrgs.comparison.plan import PlannedRun
from mrgs.system.child import OUT_OF_MEMORY, Child, Message
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import write_yaml
from mrgs.system.threads import available_cores

CHILD = ("-m", "mrgs.comparison.child")
TICK_S = 1.0


@dataclass(eq=False)
class _Run:
    job: PlannedRun
    child: Child


_Inbox = queue.Queue[tuple[_Run, Message | None]]
"""What the children send; None when one has ended."""


def run_jobs(
    jobs: Sequence[PlannedRun],
    count: int,
    lpips_weights: Path | None,
    on_message: Callable[[PlannedRun, Message], None],
    on_tick: Callable[[], None],
    device: DeviceName = "auto",
    child: Sequence[str] = CHILD,
) -> dict[PlannedRun, str]:
    """Execute all runs, ``count`` at a time.

    Args:
        jobs: in the order in which they are started.
        count: how many processes at a time; the machine's cores are divided among as many as there
            can be.
        lpips_weights: weights for LPIPS.
        on_message: called with each message of a child, and with ``{"start": True}`` when it
            starts.
        on_tick: called about once a second.
        device: where they train and render.
        child: arguments of the Python process that does a run.

    Returns:
        of each job that failed, why: one line.

    Raises:
        KeyboardInterrupt: Ctrl-C; the running jobs have left checkpoints. A second one ends them at
            once.
    """
    waiting, running, failures = list(jobs), list[_Run](), dict[PlannedRun, str]()
    inbox: _Inbox = queue.Queue()
    threads = threads_each(max(1, min(count, len(jobs))))
    try:
        while waiting or running:
            while waiting and len(running) < count:
                job = waiting.pop(0)
                running.append(_start(child, job, threads, device, lpips_weights, inbox))
                on_message(job, {"start": True})
            _receive(inbox, running, failures, on_message)
            on_tick()
    except KeyboardInterrupt:
        for run in running:
            run.child.stop()
        while running:
            _receive(inbox, running, failures, on_message)
        raise
    finally:
        for run in running:  # something went wrong here, or a second Ctrl-C
            run.child.close()
    return failures


def threads_each(count: int) -> int:
    """The threads of one of ``count`` processes."""
    return max(1, available_cores() // count)


def _start(
    child: Sequence[str],
    job: PlannedRun,
    threads: int,
    device: DeviceName,
    lpips_weights: Path | None,
    inbox: _Inbox,
) -> _Run:
    request = {
        "scene": str(job.scene.absolute()),  # the child runs in another folder
        "folder": str(job.folder.absolute()),
        "config": write_yaml(job.config),
        "device": device,
        "lpips_weights": None if lpips_weights is None else str(lpips_weights.absolute()),
    }
    log = job.folder.parent / f"{job.folder.name}.stderr.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    limits = {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    run = _Run(job, Child(child, request, log, **limits))
    threading.Thread(target=_listen, args=(run, inbox), daemon=True).start()
    return run


def _listen(run: _Run, inbox: _Inbox) -> None:
    """Put the messages into the inbox, and None when the child has ended."""
    for message in run.child.messages():
        inbox.put((run, message))
    inbox.put((run, None))


def _receive(
    inbox: _Inbox,
    running: list[_Run],
    failures: dict[PlannedRun, str],
    on_message: Callable[[PlannedRun, Message], None],
) -> None:
    """Handle one message, or let a tick pass."""
    try:
        run, message = inbox.get(timeout=TICK_S)
    except queue.Empty:
        return
    if message is not None:
        on_message(run.job, message)
        return
    running.remove(run)
    run.child.close()
    reason = _failure(run.child)
    if reason is None:
        on_message(run.job, run.child.end)
    else:
        failures[run.job] = reason
        on_message(run.job, {"end": "error", "message": reason})


def _failure(child: Child) -> str | None:
    """The reason of a child's failure; the log is kept if it holds more."""
    reason = child.failure()
    if reason is None or child.end.get("end") == "error":
        child.log.unlink(missing_ok=True)
        return reason
    if reason == OUT_OF_MEMORY:
        return f"{reason}: run fewer at a time"
    return f"{reason}; see {child.log}"
