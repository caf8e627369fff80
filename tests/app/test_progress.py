"""What the terminal says while nothing else can be seen."""

from __future__ import annotations

import time

import pytest
from rich.console import Console

from mrgs.app import progress
from mrgs.app.progress import PrepareProgress
from mrgs.data import posed
from mrgs.method.config import make_config
from mrgs.training import compilation


class Compiled:
    text = None

    def __init__(self, config: object) -> None:
        pass


def test_photos_that_are_read_before_the_first_step_are_counted(monkeypatch, capsys):
    monkeypatch.setattr(compilation, "Countdown", Compiled)
    monkeypatch.setattr(progress, "PLAIN_LINE_EVERY_S", 0.01)
    lines = ""
    with progress._compiling(make_config("mrgs-plus", "fast"), Console(force_terminal=False)):
        posed._Reading.photos += 3
        for _ in range(500):
            lines += capsys.readouterr().out
            if "reading photos for the start: 3" in lines:
                return
            time.sleep(0.01)
    pytest.fail(f"no line about the photos: {lines!r}")


def test_a_start_that_takes_no_time_says_nothing(monkeypatch, capsys):
    monkeypatch.setattr(compilation, "Countdown", Compiled)
    with progress._compiling(make_config("mrgs-plus", "fast"), Console(force_terminal=False)):
        pass
    assert capsys.readouterr().out == ""


def test_a_step_without_a_forecast_tells_the_time_left_by_its_own_pace(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    shown = PrepareProgress()
    for seconds, done in [(0.0, 0), (20.0, 10)]:
        now[0] = seconds
        shown.step("reading images", done, 40)
    assert capsys.readouterr().out == "reading images 10/40 | 1:00 left | 0:20\n"
