from __future__ import annotations

from pathlib import Path

import pytest

from mrgs.comparison.plan import PlannedRun
from mrgs.comparison.progress import Progress
from mrgs.training import make_config


class Teller:
    """Two jobs of 100 steps, a clock that is set by hand, and what was said."""

    def __init__(self, count: int = 1) -> None:
        config = make_config("mrgs", "fast", max_steps=100)
        self.jobs = [
            PlannedRun(Path("s"), "board", "mrgs", seed, config, Path("f")) for seed in range(2)
        ]
        self.lines: list[str] = []
        self.now = 100.0
        self.progress = Progress(self.jobs, count, self.lines.append, lambda: self.now)

    def hear(self, seed: int, at: float, **message: object) -> None:
        self.now = at
        self.progress.on_message(self.jobs[seed], message)

    def tick(self, at: float) -> str:
        self.now = at
        self.progress.on_tick()
        return self.lines[-1]


@pytest.fixture
def teller() -> Teller:
    return Teller()


def test_speed_and_time_left_leave_the_start_out(teller):
    teller.hear(0, 100.0, start=True)
    done, run = teller.tick(110.0).split(" | ")
    assert done.startswith("0 of 2")
    assert run == f"{teller.jobs[0]}: starting"
    teller.hear(0, 150.0, step=1, gaussians=10)
    teller.hear(0, 160.0, step=11, gaussians=10)
    done, run = teller.tick(160.0).split(" | ")
    assert "3 min" in done  # 89 and 100 steps at one a second
    assert "11/100" in run
    assert "1.0 steps/s" in run


def test_lines_keep_a_distance(teller):
    teller.hear(0, 100.0, start=True)
    teller.tick(110.0)
    count = len(teller.lines)
    teller.tick(115.0)
    assert len(teller.lines) == count
    teller.tick(120.0)
    assert len(teller.lines) == count + 1


def test_a_finished_run_tells_how_long_the_next_takes(teller):
    teller.hear(0, 0.0, start=True)
    teller.hear(0, 10.0, step=1, gaussians=10)
    teller.hear(0, 11.0, step=51, gaussians=10)
    teller.hear(0, 5_400.0, scored=2, of=2)
    assert teller.tick(5_400.0).endswith("scoring 2/2")
    teller.hear(0, 5_400.0, end="scored")
    ended, done = teller.lines[-1].split(" | ")
    assert ended == f"scored: {teller.jobs[0]}"
    assert done.startswith("1 of 2")
    teller.hear(1, 5_400.0, start=True)
    assert "1 h 20 min" in teller.tick(6_000.0)
    assert "less than" in teller.tick(12_000.0)


def test_side_by_side_takes_half_as_long():
    teller = Teller(count=2)
    for seed in (0, 1):
        teller.hear(seed, 0.0, start=True)
        teller.hear(seed, 10.0, step=0, gaussians=10)
    teller.hear(0, 20.0, step=4, gaussians=10)
    assert "4 min" in teller.tick(20.0)  # 96 + 100 steps at 0.4 a second, halved


def test_failures_and_stops(teller):
    teller.hear(0, 0.0, start=True)
    teller.hear(0, 1.0, end="error", message="mend it")
    ended, done = teller.lines[-1].split(" | ")
    assert ended == f"failed: {teller.jobs[0]} (mend it)"
    assert done.startswith("1 of 2")
    teller.hear(1, 2.0, start=True)
    teller.hear(1, 3.0, end="stopped")
    ended, done = teller.lines[-1].split(" | ")
    assert ended == f"stopped: {teller.jobs[1]}"
    assert done.startswith("1 of 2")
