"""``mrgs`` with clocks at the parts of a training step: ``child.py FOLDER train SCENE ...``.

Writes what it found into ``FOLDER/RANK.json`` when the command ends.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_DEVICES = Path("/proc/self/net/dev")


class Clocks:
    """Processor seconds and bytes of one process, in the steps after the first.

    Attributes:
        seconds: by part of the step.
        sent: bytes that this process has given to others.
        steps: how many were counted.
    """

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.sent = 0
        self.steps = -1
        self._loopback = 0

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        """Within this block time belongs to a part."""
        began = time.process_time()
        yield
        if self.steps >= 0:
            self.seconds[part] += time.process_time() - began

    def count_step(self) -> None:
        """A step has ended; the first one, which compiles, is not counted."""
        self.steps += 1
        if self.steps == 0:
            self._loopback = _loopback_bytes()
            self.sent = 0

    def to_json(self) -> dict[str, Any]:
        """All figures; "loopback" is what all processes of this network namespace have sent."""
        return {
            "seconds": dict(self.seconds),
            "sent": self.sent,
            "steps": self.steps,
            "loopback": _loopback_bytes() - self._loopback,
        }


def timed(clocks: Clocks, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with a clock."""

    def inner(*arguments: Any, **named: Any) -> Any:
        with clocks.of(part):
            return function(*arguments, **named)

    return inner


def install(clocks: Clocks) -> None:
    """Put clocks at the parts of a step, and count what is exchanged."""
    from mrgs.distributed.processes import Processes
    from mrgs.training import step, trainer
    from mrgs.training.state import TrainingState

    step._backward = timed(clocks, "views", step._backward)
    TrainingState.move = timed(clocks, "Adam", TrainingState.move)  # type: ignore[method-assign]
    exchange = trainer.GradientExchange
    exchange.__call__ = timed(clocks, "exchange", exchange.__call__)  # type: ignore[method-assign]
    for name in ("control_density", "align_replicas"):
        setattr(trainer, name, timed(clocks, "density", getattr(trainer, name)))
    take_step = trainer.Trainer._take_step
    gather, exchange_rows = Processes.all_gather, Processes.all_to_all

    def counted_step(self: Any) -> Any:
        with clocks.of("step"):
            statistics = take_step(self)
        clocks.count_step()
        return statistics

    def counted_gather(self: Processes, tensor: Any) -> Any:
        clocks.sent += (self.count - 1) * tensor.numel() * tensor.element_size()
        return gather(self, tensor)

    def counted_rows(self: Processes, rows: Any, sent: list[int], received: list[int]) -> Any:
        away = sum(sent) - sent[self.rank]
        clocks.sent += away * rows[:1].numel() * rows.element_size()
        return exchange_rows(self, rows, sent, received)

    trainer.Trainer._take_step = counted_step  # type: ignore[method-assign]
    Processes.all_gather = counted_gather  # type: ignore[method-assign]
    Processes.all_to_all = counted_rows  # type: ignore[method-assign]


def _loopback_bytes() -> int:
    """Bytes that have been sent on the loopback device; 0 where the system does not tell."""
    lines = _DEVICES.read_text().splitlines() if _DEVICES.exists() else []
    return next((int(line.split()[9]) for line in lines if line.split()[0] == "lo:"), 0)


def main() -> int:
    """Run the command; returns its exit code."""
    folder = Path(sys.argv.pop(1))
    from mrgs.__main__ import main as run
    from mrgs.distributed.launch import Launch

    if (launch := Launch.from_environment()) is not None:
        launch.share_cores()  # before torch is loaded
    clocks = Clocks()
    install(clocks)
    status = run()
    text = json.dumps(clocks.to_json())
    (folder / f"{os.environ.get('RANK', '0')}.json").write_text(text, encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main())
