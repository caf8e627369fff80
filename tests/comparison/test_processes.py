"""With children that only pretend, so that the processes alone are tested; and one that is real."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from mrgs.training import make_config
from mrgs_compare.plan import PlannedRun
from mrgs_compare.processes import CHILD, Progress, run_jobs, threads_each

PRETEND = """
import json, os, sys
request = json.loads(sys.argv[1])
def say(**message):
    print(json.dumps(message), flush=True)
with open(request["scene"]) as script:
    exec(script.read())
"""


@pytest.fixture
def make_jobs(tmp_path: Path) -> Callable[..., list[PlannedRun]]:
    """Jobs whose scene is a script that their children run, see ``run``; ``request`` and ``say``
    are known in it."""

    def make(script: str, count: int = 1) -> list[PlannedRun]:
        (tmp_path / "scene").write_text(script)
        config = make_config("mrgs", "fast", max_steps=3)
        return [
            PlannedRun(tmp_path / "scene", "scene", "mrgs", seed, config, tmp_path / f"seed_{seed}")
            for seed in range(count)
        ]

    return make


def run(
    jobs: list[PlannedRun],
    on_message: Callable[[PlannedRun, dict], None],
    count: int = 1,
    weights: Path | None = None,
    child: Sequence[str] = ("-c", PRETEND),
) -> dict[PlannedRun, str]:
    return run_jobs(jobs, count, weights, on_message, lambda: None, child=child)


def do(
    jobs: list[PlannedRun], count: int = 1
) -> tuple[dict[PlannedRun, str], list[tuple[int, dict]]]:
    heard: list[tuple[int, dict]] = []
    failures = run(jobs, lambda job, message: heard.append((job.seed, message)), count)
    return failures, heard


def test_messages_are_handed_on_in_order(make_jobs):
    jobs = make_jobs(
        "print('a library speaks'); say(step=1, gaussians=5); say(scored=1, of=1); "
        "say(end='scored')"
    )
    failures, heard = do(jobs)
    assert failures == {}
    assert [message for _, message in heard] == [
        {"start": True}, {"step": 1, "gaussians": 5}, {"scored": 1, "of": 1}, {"end": "scored"},
    ]  # fmt: skip
    assert list(jobs[0].folder.parent.glob("*.stderr.txt")) == []


def test_the_request_holds_the_job(make_jobs):
    (job,) = make_jobs("say(**request); say(end='scored')")
    request = do([job])[1][1][1]
    assert (request["scene"], request["folder"]) == (str(job.scene), str(job.folder))
    assert "max_steps: 3" in request["config"]
    assert request["lpips_weights"] is None


def test_the_request_holds_absolute_paths(make_jobs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (job,) = make_jobs("say(**request); say(end='scored')")
    job = replace(job, scene=Path("scene"), folder=Path("seed_0"))
    heard: list[dict] = []
    run([job], lambda job, message: heard.append(message), weights=Path("lpips.safetensors"))
    paths = [heard[1][key] for key in ("scene", "folder", "lpips_weights")]
    assert paths == [str(tmp_path / name) for name in ("scene", "seed_0", "lpips.safetensors")]


@pytest.mark.slow
def test_a_poisoned_current_folder_is_not_imported_from(tmp_path, monkeypatch):
    """The real child, which fails for want of a scene: all that it imports before comes from
    elsewhere."""
    monkeypatch.chdir(tmp_path)
    for name in ("json", "mrgs", "numpy", "torch"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('poisoned')")
    job = PlannedRun(
        Path("missing"),
        "missing",
        "mrgs",
        0,
        make_config("mrgs", "fast", max_steps=3),
        Path("seed_0"),
    )
    (reason,) = run([job], lambda job, message: None, child=CHILD).values()
    assert reason.startswith(str(tmp_path / "missing"))


def test_cores_are_divided(make_jobs):
    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_WAIT_POLICY")
    jobs = make_jobs(
        f"say(step=0, threads=[os.environ[name] for name in {names}]); say(end='scored')", count=2
    )
    told = [message["threads"] for _, message in do(jobs, 2)[1] if "threads" in message]
    assert told == [[str(threads_each(2))] * 2 + ["PASSIVE"]] * 2
    assert threads_each(10_000) == 1


def test_fewer_runs_than_processes_have_all_cores(make_jobs):
    jobs = make_jobs(
        "say(step=0, threads=os.environ['NUMBA_NUM_THREADS']); say(end='scored')", count=2
    )
    for started in (1, 2):
        told = [message["threads"] for _, message in do(jobs[:started], 3)[1] if "step" in message]
        assert told == [str(threads_each(started))] * started


def test_only_so_many_run_at_a_time(make_jobs):
    jobs = make_jobs("import time; time.sleep(0.2); say(end='scored')", count=5)
    heard = do(jobs, 2)[1]
    running, most = 0, 0
    for _, message in heard:
        running += 1 if "start" in message else -1
        most = max(most, running)
    assert most == 2
    assert {seed for seed, message in heard if message == {"end": "scored"}} == set(range(5))


def test_what_the_user_can_mend_is_told_and_others_go_on(make_jobs):
    script = (
        "say(end='error', message='mend it') if 'seed_0' in request['folder'] else "
        "say(end='scored')"
    )
    jobs = make_jobs(script + "; sys.exit(2 if 'seed_0' in request['folder'] else 0)", count=2)
    failures, heard = do(jobs)
    assert failures == {jobs[0]: "mend it"}
    assert (1, {"end": "scored"}) in heard


def test_a_crash_is_told_with_its_last_line_and_its_whole_output_kept(make_jobs, tmp_path):
    jobs = make_jobs("raise RuntimeError('it broke')")
    (reason,) = do(jobs)[0].values()
    kept = tmp_path / "seed_0.stderr.txt"
    assert "status 1" in reason
    assert "RuntimeError: it broke" in reason
    assert reason.endswith(str(kept))
    assert "Traceback" in kept.read_text()


def test_a_child_that_says_nothing_has_failed(make_jobs):
    (reason,) = do(make_jobs("pass"))[0].values()
    assert "status 0" in reason


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal here")
def test_a_child_that_the_system_ended(make_jobs):
    (reason,) = do(make_jobs("os.kill(os.getpid(), 9)"))[0].values()
    assert "signal 9" in reason
    assert "fewer" in reason


def interrupt(when: Callable[[], bool], times: int = 1) -> None:
    def wait() -> None:
        for _ in range(times):
            while not when():
                time.sleep(0.02)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.5)

    threading.Thread(target=wait, daemon=True).start()


def test_ctrl_c_closes_the_childs_input_and_waits_for_it(make_jobs):
    jobs = make_jobs(
        "say(step=1, gaussians=1); sys.stdin.read(); say(step=2, gaussians=1); say(end='stopped')",
        2,
    )
    heard: list[dict] = []
    interrupt(lambda: {"step": 1, "gaussians": 1} in heard)
    with pytest.raises(KeyboardInterrupt):
        run(jobs, lambda job, message: heard.append(message))
    assert heard == [
        {"start": True},
        {"step": 1, "gaussians": 1},
        {"step": 2, "gaussians": 1},
        {"end": "stopped"},
    ]


def test_a_second_ctrl_c_ends_a_child_that_does_not_listen(make_jobs):
    jobs = make_jobs("say(step=os.getpid(), gaussians=1); import time; time.sleep(60)")
    heard: list[dict] = []
    interrupt(lambda: len(heard) > 1, times=2)
    with pytest.raises(KeyboardInterrupt):
        run(jobs, lambda job, message: heard.append(message))
    with pytest.raises(ProcessLookupError):
        os.kill(heard[1]["step"], 0)


@pytest.mark.slow
def test_a_real_child_stops_with_a_checkpoint(small_scene, tmp_path):
    config = make_config("3dgs-rgbt", "fast", max_steps=2_000, max_gaussians=60)
    job = PlannedRun(small_scene, "balls", "3dgs-rgbt", 0, config, tmp_path / "seed_0")
    heard: list[dict] = []
    interrupt(lambda: any("step" in message for message in heard))
    with pytest.raises(KeyboardInterrupt):
        run([job], lambda job, message: heard.append(message), child=CHILD)
    assert heard[-1] == {"end": "stopped"}
    (checkpoint,) = (job.folder / "checkpoints").glob("*.safetensors")
    assert 1 <= int(checkpoint.stem.removeprefix("step_")) < 2_000


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
