"""What this computer can do now: cores, their speed, free memory."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch

from mrgs.system.memory import free_memory
from mrgs.system.threads import available_cores

REFERENCE_UNIT_S = 0.0018
"""Processor time of a probe's unit on the computer that the costs were measured on: a core of an
AMD EPYC (Zen 4)."""

PROBE_S = 1.0
"""How long the probe takes at least."""

_SIZE = 384


@dataclass(frozen=True)
class Computer:
    """What a computer can do, measured.

    Attributes:
        cores: that this process may use.
        share: cores' worth of time that this process gets beside other work, at most ``cores``.
        speed: of a core, 1 where the costs were measured.
        free_memory: bytes; None if not known.
    """

    cores: int
    share: float
    speed: float
    free_memory: int | None = None

    def seconds(self, cost: float, parallel: float) -> float:
        """Time that work takes.

        Args:
            cost: processor seconds on the reference.
            parallel: share of the work that is spread over the cores, 0 to 1 (Amdahl).
        """
        alone = min(self.share, 1.0)
        return cost / self.speed * ((1 - parallel) / alone + parallel / self.share)


def measure_computer() -> Computer:
    """Measure this computer for a second, beside whatever else runs on it."""
    cores = available_cores()
    left = torch.linspace(-1, 1, _SIZE * _SIZE).reshape(_SIZE, _SIZE)
    indices = torch.arange(_SIZE * _SIZE).flip(0)
    _work(left, indices)
    started, used, units = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - started < PROBE_S:
        _work(left, indices)
        units += 1
    wall_s, processor_s = time.perf_counter() - started, time.process_time() - used
    share = min(max(processor_s / wall_s, 0.05), cores)
    return Computer(cores, share, units * REFERENCE_UNIT_S / processor_s, free_memory())


def _work(left: torch.Tensor, indices: torch.Tensor) -> None:
    """A unit: matrix products, exponentials and scattered memory, as training has them."""
    product = left @ left
    values = torch.exp(-product.abs()).reshape(-1)
    torch.zeros_like(values).index_add_(0, indices, values)
