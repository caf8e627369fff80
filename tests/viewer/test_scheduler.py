from __future__ import annotations

import threading
import time
from concurrent.futures import CancelledError

import pytest

from mrgs.viewer.scheduler import RenderScheduler

PATIENCE_S = 10.0


class Recorder:
    """Draws nothing, notes what it was asked for, and can be held in the middle of a picture."""

    def __init__(self) -> None:
        self.drawn: list[bool] = []
        self.errors: list[Exception] = []
        self.go = threading.Event()
        self.go.set()
        self.raises: list[Exception] = []

    def draw(self, coarse: bool) -> None:
        self.drawn.append(coarse)
        assert self.go.wait(PATIENCE_S)
        if self.raises:
            raise self.raises.pop()

    def wait_for(self, drawn: list[bool]) -> None:
        until = time.monotonic() + PATIENCE_S
        while self.drawn != drawn and time.monotonic() < until:
            time.sleep(0.005)
        time.sleep(0.05)  # nothing more may come
        assert self.drawn == drawn


@pytest.fixture
def recorder():
    return Recorder()


@pytest.fixture
def scheduler(recorder):
    scheduler = RenderScheduler(recorder.draw, recorder.errors.append, rest_s=0.02)
    yield scheduler
    recorder.go.set()
    scheduler.close()


def test_coarse_on_the_way_sharp_at_rest(scheduler, recorder):
    scheduler.moved()
    recorder.wait_for([True, False])
    assert not scheduler.busy


def test_other_changes_are_sharp_at_once(scheduler, recorder):
    scheduler.refresh()
    recorder.wait_for([False])


def test_what_comes_meanwhile_is_one_picture(scheduler, recorder):
    recorder.go.clear()
    scheduler.moved()
    until = time.monotonic() + PATIENCE_S
    while not recorder.drawn and time.monotonic() < until:
        time.sleep(0.005)
    for _ in range(20):
        scheduler.moved()
    recorder.go.set()
    recorder.wait_for([True, True, False])


def test_no_sharp_picture_while_it_moves(recorder):
    scheduler = RenderScheduler(recorder.draw, recorder.errors.append, rest_s=30.0)
    scheduler.moved()
    recorder.wait_for([True])
    scheduler.moved()
    recorder.wait_for([True, True])
    assert scheduler.busy
    scheduler.close()


def test_a_failure_is_told_and_the_next_picture_drawn(scheduler, recorder):
    recorder.raises = [ValueError("no such luck")]
    scheduler.refresh()
    recorder.wait_for([False])
    assert [str(error) for error in recorder.errors] == ["no such luck"]
    scheduler.refresh()
    recorder.wait_for([False, False])


def test_a_closed_source_ends_it_in_silence(scheduler, recorder):
    recorder.raises = [CancelledError()]
    scheduler.refresh()
    recorder.wait_for([False])
    scheduler.refresh()
    recorder.wait_for([False])
    assert recorder.errors == []


def test_a_closed_scheduler_draws_no_more(scheduler, recorder):
    scheduler.close()
    scheduler.moved()
    recorder.wait_for([])
