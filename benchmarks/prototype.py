"""What a C++ prototype took on another machine, and what that lets one expect of this one.

The prototype renders and differentiates the same fused pass with SIMD written by hand (8 floats),
on 2 cores with AVX2. Its source is not here, so it cannot be run beside the kernels. What can be
run is four torch workloads whose times on its machine were noted too. The factor of a workload is
its time here over its time there; the prototype's time here is then estimated as its time there
times the factor.

An estimate it remains. Each workload leans on the machine in its own way, and torch chooses its
code by the instructions that a machine offers. So the factor is given as a range:

- ``MLP``, a chain of matrix products, fixes the arithmetic exactly. It is measured twice: with all
  instructions of this machine, and with torch kept to AVX2, because it is not known which ones
  torch had there. These two factors are the range.
- ``SSIM_CONV`` is shown and not used: its convolution's algorithm changes with the instruction set
  by up to 6 times.
- ``SSIM_SHIFTED`` and ``ADAM`` are shown and not used: they move memory, the rasterizer computes;
  and how the one was written and over how many parameters the other ran there is not known.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any, NamedTuple

FUSED = "fused pass"
MLP = "MLP 32-64-64-1, 50,000 rows"
SSIM_CONV = "SSIM by conv2d, 4 channels"
SSIM_SHIFTED = "SSIM by shifted adds, 4 channels"
ADAM = "Adam, fused, 50,000 × 60"

Size = tuple[int, int, int]
"""Gaussians, width, height."""

CPP_MS: dict[Size, float] = {
    (50_000, 320, 240): 33,
    (50_000, 640, 480): 67,
    (200_000, 640, 480): 127,
}
NUMBA_MS: dict[Size, float] = {
    (50_000, 320, 240): 37,
    (50_000, 640, 480): 88,
    (200_000, 640, 480): 229,
}
"""The same machine's Numba prototype, with an explicit vector type."""

TARGET_RATIO: dict[Size, float] = {
    (50_000, 320, 240): 1.3,
    (50_000, 640, 480): 1.3,
    (200_000, 640, 480): 1.5,
}
"""How much slower than the C++ prototype the fused pass may be."""

_SSIM_MS = {320: ((41.0, 51.0), 25.0), 640: ((168.0, 300.0), 124.0)}
"""By image width: SSIM by conv2d (a range was noted), and by shifted adds."""


def known_ms(workload: str, width: int) -> tuple[float, float]:
    """Least and largest time of a torch workload on the prototype's machine, forward and
    backward."""
    by_convolution, by_shifts = _SSIM_MS[width]
    ranges = {
        MLP: (39.0, 39.0),
        ADAM: (3.0, 3.0),
        SSIM_CONV: by_convolution,
        SSIM_SHIFTED: (by_shifts, by_shifts),
    }
    return ranges[workload]


def factor(workload: str, width: int, measured_ms: float) -> float:
    """This machine's time over the prototype's machine's; against the geometric middle where that
    was a range."""
    low, high = known_ms(workload, width)
    return measured_ms / (low * high) ** 0.5


class Estimate(NamedTuple):
    """The fused pass beside the estimated C++ time on this machine.

    Attributes:
        size: Gaussians, width, height.
        measured_ms: median of the fused pass here.
        plain_ratio: measured over the C++ time on its own machine, nothing scaled.
        ratios: measured over the estimate, least and largest.
        target: the ratio to stay below.
    """

    size: Size
    measured_ms: float
    plain_ratio: float
    ratios: tuple[float, float]
    target: float

    @property
    def verdict(self) -> str:
        """Whether the target is met by both ends of the range, by one, or by neither."""
        met = [ratio <= self.target for ratio in self.ratios]
        return "met" if all(met) else "undecided" if any(met) else "missed"


def estimate(size: Size, measured: Mapping[str, Mapping[str, Any]]) -> Estimate:
    """Scale the C++ time by the MLP's factors.

    Args:
        size: Gaussians, width, height.
        measured: the timings of the groups "prototype" and "prototype-avx2"; each factor is applied
            to the fused pass that was measured in turns with it.
    """
    ratios = [
        timings[FUSED]["median_ms"]
        / (CPP_MS[size] * factor(MLP, size[1], timings[MLP]["median_ms"]))
        for timings in measured.values()
    ]
    fused_ms = statistics.median(timings[FUSED]["median_ms"] for timings in measured.values())
    return Estimate(
        size, fused_ms, fused_ms / CPP_MS[size], (min(ratios), max(ratios)), TARGET_RATIO[size]
    )
