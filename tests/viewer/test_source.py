from __future__ import annotations

import threading
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import replace

import pytest

from mrgs.viewer.source import LIVE_SHARE, MAX_CREDIT_S, LiveSource, TrainedSource


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def pool():
    with ThreadPoolExecutor(4) as pool:
        yield pool


def queued(source: LiveSource, pool: ThreadPoolExecutor, job):
    """Ask for a job from another thread, and return when it waits for its turn."""
    before = len(source._jobs)
    future = pool.submit(source.run, job)
    while len(source._jobs) == before and not future.done():
        threading.Event().wait(0.002)
    return future


def test_jobs_on_a_trained_model_never_overlap(small_run, pool):
    source, running, most = TrainedSource(small_run.model), [], []

    def job(model):
        running.append(1)
        most.append(len(running))
        threading.Event().wait(0.01)
        running.pop()
        return model

    assert all(model is small_run.model for model in pool.map(source.run, [job] * 8))
    assert max(most) == 1


def test_the_training_runs_the_jobs_on_its_own_thread(small_run, pool):
    source = LiveSource()
    future = queued(source, pool, lambda model: (model, threading.get_ident()))
    assert not future.done()
    source.serve(small_run.model)
    assert future.result(60) == (small_run.model, threading.get_ident())


def test_looking_never_takes_more_than_its_share(small_run, pool):
    """Steps of 100 ms, and always another picture of 30 ms wanted."""
    clock = Clock()
    source = LiveSource(clock=clock)
    steps, spent, pictures = 2000, 0.0, 0

    def job(_):
        clock.now += 0.03

    future = queued(source, pool, job)
    for _ in range(steps):
        clock.now += 0.1
        before = clock.now
        source.serve(small_run.model)
        spent += clock.now - before
        if clock.now > before:
            pictures += 1
            future.result(60)
            future = queued(source, pool, job)
    assert pictures > 200
    assert spent <= LIVE_SHARE * clock.now + 0.03
    assert spent < 0.05 * steps * 0.1
    source.close()


def test_painting_counts_too(small_run, pool):
    clock, thread_clock = Clock(), Clock()
    source = LiveSource(clock=clock, thread_clock=thread_clock)
    for thread_clock.now in (0.4, 1.0):  # each counts from the one before
        source.charge()
    future = queued(source, pool, lambda _: "drawn")
    clock.now = 20.0
    source.serve(small_run.model)
    assert not future.done()
    clock.now = 30.0
    source.serve(small_run.model)
    assert future.result(60) == "drawn"


def test_unused_time_is_not_saved_for_a_hiccup(small_run, pool):
    clock = Clock()
    source = LiveSource(clock=clock)
    clock.now = 1e6
    slow = queued(source, pool, lambda _: setattr(clock, "now", clock.now + 2 * MAX_CREDIT_S))
    source.serve(small_run.model)
    slow.result(60)
    future = queued(source, pool, lambda _: None)
    clock.now += 1.0
    source.serve(small_run.model)
    assert not future.done()
    source.close()


def test_a_job_that_fails_harms_only_itself(small_run, pool):
    source = LiveSource()

    def fails(_):
        raise ValueError("a broken picture")

    future = queued(source, pool, fails)
    source.serve(small_run.model)
    with pytest.raises(ValueError, match="a broken picture"):
        future.result(60)


def test_a_model_without_neighbours_waits_for_the_next_step(small_run, pool):
    """Right after a densification they are not known yet."""
    source = LiveSource()
    future = queued(source, pool, lambda _: "drawn")
    source.serve(replace(small_run.model, neighbours=None))
    assert not future.done()
    source.serve(small_run.model)
    assert future.result(60) == "drawn"


def test_a_closed_source_lets_nobody_wait(small_run, pool):
    source = LiveSource()
    future = queued(source, pool, lambda _: None)
    source.close()
    for waiting in (future, pool.submit(source.run, lambda _: None)):
        with pytest.raises(CancelledError):
            waiting.result(60)
