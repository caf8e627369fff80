from __future__ import annotations

import logging
import threading
from concurrent.futures import CancelledError

import pytest

from mrgs.viewer.source import Worker
from tests.helpers.browsers import wait_until

PATIENCE_S = 60.0


class Held:
    """A job that lasts until it is let go."""

    def __init__(self) -> None:
        self.begun, self.go = threading.Event(), threading.Event()

    def __call__(self) -> None:
        self.begun.set()
        assert self.go.wait(PATIENCE_S)


@pytest.fixture
def worker():
    worker = Worker()
    yield worker
    worker.close()


@pytest.fixture
def held(worker):
    """The worker is in the middle of a job."""
    held = Held()
    worker.put("held", held)
    assert held.begun.wait(PATIENCE_S)
    yield held
    held.go.set()


def finish(worker: Worker, held: Held) -> None:
    """Until all jobs are done."""
    done = threading.Event()
    worker.put("last", done.set)
    held.go.set()
    assert done.wait(PATIENCE_S)


def test_jobs_are_done_in_turn_and_the_newest_of_a_kind_counts(worker, held):
    done = []
    worker.put("a", lambda: done.append("a1"))
    worker.put("b", lambda: done.append("b1"))
    worker.put("a", lambda: done.append("a2"))
    assert worker.busy
    finish(worker, held)
    assert done == ["a2", "b1"]


def test_jobs_of_somebody_who_left_are_dropped(worker, held):
    done = []
    worker.put((1, "picture"), lambda: done.append(1))
    worker.put((2, "picture"), lambda: done.append(2))
    worker.drop(lambda key: isinstance(key, tuple) and key[0] == 1)
    finish(worker, held)
    assert done == [2]


def test_a_failure_is_logged_and_the_next_job_done(worker, held, caplog):
    def fail() -> None:
        raise ValueError("no such luck")

    worker.put("bad", fail)
    with caplog.at_level(logging.WARNING):
        finish(worker, held)
    assert "no such luck" in caplog.text


@pytest.mark.parametrize("how", ["closed", "cancelled"])
def test_it_ends(worker, held, how):
    done = []

    def cancelled() -> None:
        raise CancelledError

    if how == "closed":
        worker.close()
    else:
        worker.put("cancelled", cancelled)
    worker.put("late", lambda: done.append(1))
    held.go.set()
    worker.join(PATIENCE_S)
    worker.put("later", lambda: done.append(1))
    assert not worker._thread.is_alive()
    assert done == []


def test_a_browser_with_many_jobs_does_not_keep_others_waiting(worker, held):
    done = []
    for number in range(3):
        worker.put(("a", "change", number), lambda number=number: done.append(f"a{number}"))
    worker.put(("b", "picture"), lambda: done.append("b"))
    worker.put(("c", "picture"), lambda: done.append("c"))
    finish(worker, held)
    assert done == ["a0", "b", "c", "a1", "a2"]


def test_a_browser_that_always_has_a_new_job_leaves_others_their_turns(worker, held):
    done = []

    def again(number: int) -> None:
        done.append(f"a{number}")
        if number < 4:
            worker.put(("a", "picture"), lambda: again(number + 1))

    worker.put(("a", "picture"), lambda: again(0))
    for number in range(3):
        worker.put(("b", "change", number), lambda number=number: done.append(f"b{number}"))
    finish(worker, held)
    wait_until(lambda: len(done) == 8, "all is done")
    assert done == ["a0", "b0", "a1", "b1", "a2", "b2", "a3", "a4"]
