"""A training for hours: memory and descriptors stay where they are."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.faults.program import SMALL, ended, logged_step, small_scene, start
from tests.faults.tally import Tally

SAMPLE_EVERY_S = 2.0
MOST_MB_PER_HOUR = 20.0
CONFIG = """
checkpoint_every: 100
densification: {start: 10, stop: 100000000, every: 100, gradient_threshold: 1.0e-6}
"""


class Sample(NamedTuple):
    """A process at a moment: seconds since its start, resident memory, open descriptors, step."""

    seconds: float
    resident_mb: float
    descriptors: int
    step: int


def training(folder: Path, seconds: float) -> Tally:
    """Train, densify and save for a while; the first third does not count."""
    tally, scene = Tally(), small_scene(folder / "scene")
    config = folder / "soak.yaml"
    config.write_text(CONFIG)
    output = folder / "soak"
    options = (*SMALL, "--max-steps", 100_000_000, "--config", config)
    process = start("train", scene, "--output", output, *options)
    began, samples = time.monotonic(), list[Sample]()
    while process.poll() is None and time.monotonic() - began < seconds:
        time.sleep(SAMPLE_EVERY_S)
        samples.append(_sample(process.pid, time.monotonic() - began, output))
    process.terminate()
    found = ended(process)
    warm = np.array([sample for sample in samples[len(samples) // 3 :] if sample.step > 0])
    tally.judge("training", found.status == 143 and len(warm) > 2, found)
    if len(warm) > 2:
        slope = float(np.polyfit(warm[:, 0], warm[:, 1], 1)[0] * 3600)
        spread = int(np.ptp(warm[:, 2]))
        # The first minutes say little about an hour.
        tally.judge("memory", slope < MOST_MB_PER_HOUR or seconds < 1800, f"{slope:.1f} MB/h")
        tally.judge("descriptors", spread <= 4, f"they vary by {spread}")
        tally.figure = f"{warm[-1, 3]:,.0f} steps, {slope:+.1f} MB/h, descriptors ±{spread}"
    return tally


def _sample(pid: int, seconds: float, output: Path) -> Sample:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        descriptors = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    except (OSError, json.JSONDecodeError):
        return Sample(seconds, 0.0, 0, 0)
    return Sample(seconds, pages * 4096 / 1e6, descriptors, logged_step(output))
