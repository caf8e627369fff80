"""Runs that several processes share out; the processes are threads here, and the runs pretend."""

from __future__ import annotations

import threading

from mrgs.comparison import compare, shared
from mrgs.comparison.plan import PlannedRun
from mrgs.distributed.launch import Launch
from mrgs.errors import ConfigError, PeerError, RunError
from mrgs.training import make_config, peers
from tests.helpers.comparison import tiny_options
from tests.helpers.threaded_processes import together


def jobs_of(folder, count: int) -> list[PlannedRun]:
    config = make_config("mrgs", "fast", max_steps=3)
    return [
        PlannedRun(folder / "scene", "scene", "mrgs", seed, config, folder / f"seed_{seed}")
        for seed in range(count)
    ]


def test_each_run_is_done_once_and_the_first_process_hears_of_all(tmp_path):
    jobs, done, lock = jobs_of(tmp_path, 5), [], threading.Lock()

    def run(given, count, weights, on_message, on_tick, device, threads):
        (job,) = given
        assert (count, weights, device, threads) == (1, None, "cpu", Launch(0, 2, 2, 0).threads)
        with lock:
            done.append((job.seed, job.config, job.folder))
        on_message(job, {"start": True})
        on_tick()
        on_message(job, {"end": "scored"})
        return {job: "it crashed"} if job.seed == 2 else {}

    heard = []

    def work(processes):
        if not processes.is_first:
            return shared.follow_jobs(processes, None, "cpu", run)
        return shared.lead_jobs(
            jobs, processes, None, lambda *told: heard.append(told), lambda: None, "cpu", run
        )

    failures, nothing = together(work, 2)
    assert nothing is None
    assert failures == {jobs[2]: "it crashed"}
    assert sorted(done, key=lambda each: each[0]) == [
        (job.seed, job.config, job.folder.absolute()) for job in jobs
    ]
    for job in jobs:
        assert [message for each, message in heard if each is job] == [
            {"start": True}, {"end": "scored"},
        ]  # fmt: skip


def test_processes_of_different_versions_do_not_share_runs(tmp_path, monkeypatch):
    versions = iter(["1.0", "2.0"])
    monkeypatch.setattr(peers, "version", lambda name: next(versions))

    def work(processes):
        if not processes.is_first:
            return shared.follow_jobs(processes, None, "cpu")
        return shared.lead_jobs(
            jobs_of(tmp_path, 1), processes, None, lambda *told: None, lambda: None, "cpu"
        )

    refused, other = together(work, 2)
    assert isinstance(refused, RunError)
    assert isinstance(other, PeerError)
    assert "1.0" in str(refused)
    assert "2.0" in str(refused)


def test_several_jobs_in_each_of_several_processes_are_refused(small_scene, tmp_path):
    def start(processes):
        compare([small_scene], tmp_path, tiny_options(), jobs=2, processes=processes)

    (refusal,) = together(start, 1)
    assert isinstance(refusal, ConfigError)
    assert "torchrun" in str(refusal)
    assert refusal.options == ("jobs",)
