"""The runs of a comparison, shared out among the processes of one torchrun: each takes the next run
until none is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from mrgs.comparison.methods import from_text
from mrgs.comparison.plan import PlannedRun
from mrgs.comparison.processes import Message, run_jobs
from mrgs.distributed.processes import Processes
from mrgs.distributed.work_queue import WorkQueue
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import write_yaml
from mrgs.training.peers import require_same_version

ORPHAN_S = 60.0
"""How long the run of a process that was killed may take to save a checkpoint."""

OnMessage = Callable[[PlannedRun, Message], None]
Execute = Callable[..., dict[PlannedRun, str]]

_QUEUE = "comparison"


def lead_jobs(
    jobs: Sequence[PlannedRun],
    processes: Processes,
    lpips_weights: Path | None,
    on_message: OnMessage,
    on_tick: Callable[[], None],
    device: DeviceName = "auto",
    run: Execute = run_jobs,
) -> dict[PlannedRun, str]:
    """Execute all runs on all processes; called by the first one, see ``run_jobs``.

    Args:
        jobs: in the order in which they are started.
        processes: that execute them, one run at a time each.
        lpips_weights: weights for LPIPS.
        on_message: called with each message of a run, on whichever process.
        on_tick: called about once a second.
        device: where they train and render.
        run: executes one of them, as ``run_jobs`` does.

    Returns:
        of each job that failed, why: one line.

    Raises:
        RunError: another process is of another version of the program.
    """
    queue = WorkQueue(processes, _QUEUE)
    queue.fill([_to_json(job) for job in jobs])
    require_same_version(processes)
    failures: dict[PlannedRun, str] = {}

    def hear(message: dict[str, Any]) -> None:
        if "finished" in message:
            if message["result"] is not None:
                failures[jobs[message["finished"]]] = message["result"]
            return
        on_message(jobs[message["job"]], message["message"])

    def tick() -> None:
        for message in queue.new_messages():
            hear(message)
        on_tick()

    _work(queue, processes, lpips_weights, tick, device, run)
    for message in queue.messages(on_tick):
        hear(message)
    return failures


def follow_jobs(
    processes: Processes,
    lpips_weights: Path | None,
    device: DeviceName = "auto",
    run: Execute = run_jobs,
) -> None:
    """Execute runs of the comparison that the first process leads, until none is left.

    Raises:
        PeerError: a process is of another version of the program than the first one.
    """
    queue = WorkQueue(processes, _QUEUE)
    queue.wait_until_filled()  # the first process may still end with an error of its own
    require_same_version(processes)
    _work(queue, processes, lpips_weights, lambda: None, device, run)


def _work(
    queue: WorkQueue,
    processes: Processes,
    lpips_weights: Path | None,
    on_tick: Callable[[], None],
    device: DeviceName,
    run: Execute,
) -> None:
    while (piece := queue.take()) is not None:
        job = _from_json(piece.content)
        _wait_for_orphan(job.folder)
        report = partial(_report, queue, piece.number)
        threads = processes.launch.threads
        failures = run([job], 1, lpips_weights, report, on_tick, device, threads=threads)
        queue.finish(piece, failures.get(job))


def _report(queue: WorkQueue, number: int, _: PlannedRun, message: Message) -> None:
    queue.report(job=number, message=message)


def _wait_for_orphan(folder: Path) -> None:
    """Let the run of a process that was killed end: it holds the folder while it saves a
    checkpoint."""
    if folder.is_dir():
        try:
            with FileLock(folder / ".lock", timeout=ORPHAN_S):
                pass
        except (OSError, Timeout):  # the run itself says what is wrong
            return


def _to_json(job: PlannedRun) -> dict[str, Any]:
    return {
        "scene": str(job.scene.absolute()),
        "scene_name": job.scene_name,
        "method": job.method,
        "seed": job.seed,
        "config": write_yaml(job.config),
        "folder": str(job.folder.absolute()),
    }


def _from_json(values: dict[str, Any]) -> PlannedRun:
    paths = {name: Path(values[name]) for name in ("scene", "folder")}
    return PlannedRun(**{**values, **paths, "config": from_text(values["config"])})
