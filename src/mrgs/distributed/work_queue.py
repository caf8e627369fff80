"""Work that several processes share out: each takes the next piece until none is left."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch.distributed as dist

from mrgs.distributed.processes import Processes

_POLL_S = 0.2


class Piece(NamedTuple):
    """A piece of work.

    Attributes:
        number: its place in the queue, from 0.
        content: what it is, as JSON keeps it.
    """

    number: int
    content: Any


class WorkQueue:
    """A queue in torchrun's key-value store, which the first process fills and all empty.

    After a restart the queue is empty: fill it with what is not done yet. A process that is killed
    takes its piece with it, and torchrun then restarts all.

    Args:
        processes: that share the work.
        name: of the queue, the same on all processes; one for each queue of a program.
    """

    def __init__(self, processes: Processes, name: str) -> None:
        self._processes = processes
        self._store = dist.PrefixStore(f"queue/{name}", processes.store)
        self._read = self._finished = 0

    def fill(self, contents: Sequence[Any]) -> None:
        """Offer these pieces, in this order; the first process does so, once."""
        with self._processes.linked():
            for number, content in enumerate(contents):
                self._store.set(f"piece/{number}", json.dumps(content))
            self._store.set("count", str(len(contents)))

    def wait_until_filled(self) -> None:
        """Return once the first process has filled the queue."""
        with self._processes.linked():
            while not self._store.check(["count"]):  # a wait of the store would hold up signals
                time.sleep(_POLL_S)

    def __len__(self) -> int:
        """How many pieces there are in all; waits until the queue is filled."""
        self.wait_until_filled()
        with self._processes.linked():
            return int(self._store.get("count"))

    def take(self) -> Piece | None:
        """The next piece that no process has; None if none is left. Waits until the queue is
        filled."""
        count = len(self)
        with self._processes.linked():
            number = self._store.add("taken", 1) - 1
            if number >= count:
                return None
            return Piece(number, json.loads(self._store.get(f"piece/{number}")))

    def report(self, **message: Any) -> None:
        """Send a message to the first process."""
        with self._processes.linked():
            number = self._store.add("sent", 1) - 1
            self._store.set(f"message/{number}", json.dumps(message))

    def finish(self, piece: Piece, result: Any = None) -> None:
        """Say that a piece is done, and how it went."""
        self.report(finished=piece.number, result=result)

    def messages(self, on_wait: Callable[[], None] = lambda: None) -> Iterator[dict[str, Any]]:
        """All messages, as they come, until every piece is finished; the first process reads them.

        Args:
            on_wait: called several times a second while there is none.
        """
        while self._finished < len(self):
            found = self.new_messages()
            yield from found
            if not found:
                on_wait()
                time.sleep(_POLL_S)

    def new_messages(self) -> list[dict[str, Any]]:
        """The messages that have come since the last call, without waiting."""
        found = []
        with self._processes.linked():
            while self._store.check([f"message/{self._read}"]):
                found.append(json.loads(self._store.get(f"message/{self._read}")))
                self._read += 1
        self._finished += sum("finished" in message for message in found)
        return found
