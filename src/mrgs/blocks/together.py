"""The blocks of a scene, shared out among the processes of one torchrun."""

from __future__ import annotations

from mrgs.blocks.train import BlockTraining
from mrgs.distributed.processes import Processes
from mrgs.distributed.work_queue import WorkQueue
from mrgs.errors import FolderInUseError, MrgsError, RunError
from mrgs.training.peers import require_alike


def train_together(training: BlockTraining, processes: Processes) -> None:
    """Train the blocks that are left, each in one process, and join them.

    The first process makes the coarse model and the plan, the others wait for them; then each takes
    blocks until none is left, and the first one joins them.

    Raises:
        RunError: in the first process: a block could not be trained, and all others are finished;
            or another process is of another version, was started differently, or sees another
            scene.
        PeerError: the same, in that process.
        MrgsError: as ``BlockTraining.train_block``, for the first process's own work.
        LinkError, PeerError: another process is gone.
    """
    require_alike(processes, training.config, training.scene)
    queue = WorkQueue(processes, "blocks")
    if processes.is_first:
        queue.fill(training.unfinished())
    while (piece := queue.take()) is not None:
        queue.finish(piece, _failure(training, piece.content))
    if not processes.is_first:
        return
    failures = [each["result"] for each in queue.messages() if each.get("result") is not None]
    if failures:
        raise RunError(failures[0])
    training.join()


def _failure(training: BlockTraining, number: int) -> str | None:
    """Train a block; why it failed, if it did."""
    try:
        training.train_block(number)
    except FolderInUseError:  # a process that torchrun did not start trains it
        return None
    except MrgsError as error:
        return str(error)
    return None
