"""The GPU benchmark where there is no GPU: its logic, and every part at tiny sizes through the CPU
kernels."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
import sys
import time
import warnings
import zipfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import SimpleNamespace

import pytest
import torch

from benchmarks import gpu, gpu_correctness, gpu_gsplat, gpu_stages, gpu_timing, gpu_workload
from benchmarks.gpu_plan import FULL, TRIAL
from benchmarks.gpu_timing import Clock, PeakMemory, ceilings, host_waits
from benchmarks.plan import ONE_RUN, Effort
from mrgs.method.config import make_config

CPU = torch.device("cpu")


def rows_of(part: str) -> list[dict]:
    return list(gpu_stages.PARTS[part](gpu_stages.Order(TRIAL, CPU, time.time() + 600)))


def test_runs_take_turns_and_every_other_round_goes_backwards():
    order = []
    runs = {"a": lambda: order.append("a"), "b": lambda: order.append("b")}
    times = Clock(CPU).measure(runs, Effort(runs=3, seconds=9, fewest=1, warm_up=1))
    assert "".join(order) == "ab" + "ab" + "ba" + "ab"
    assert times["a"].runs == times["b"].runs == 3


def test_time_ends_the_rounds_but_not_before_the_fewest():
    effort = Effort(runs=100, seconds=0, fewest=4, warm_up=0)
    assert Clock(CPU).measure({"a": lambda: None}, effort)["a"].runs == 4


def test_ceilings_are_rates():
    found = ceilings(Clock(CPU), 32)
    assert all(value > 0 for value in found.values())
    assert found["launch_s"] < 1e-2


def test_waits_of_the_host_are_counted_by_their_lines(monkeypatch):
    modes = []
    monkeypatch.setattr(gpu_timing.torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gpu_timing.torch.cuda, "get_sync_debug_mode", lambda: 0)
    monkeypatch.setattr(gpu_timing.torch.cuda, "set_sync_debug_mode", modes.append)

    def run() -> None:
        warnings.warn(
            "Synchronization debug mode does not yet detect all synchronizing operations",
            stacklevel=1,
        )
        for _ in range(3):
            warnings.warn("called a synchronizing CUDA operation", stacklevel=1)

    ((line, count),) = host_waits(run).items()
    assert line.startswith("tests/benchmarks/test_gpu.py:")
    assert count == 3
    assert modes == ["warn", 0]


def test_nothing_waits_and_no_memory_is_taken_without_a_gpu():
    if torch.cuda.is_available():
        pytest.skip("there is one")
    assert host_waits(lambda: 1) == {}
    assert PeakMemory(CPU).nbytes() is None


def test_the_cpu_kernels_pass_every_comparison():
    rows = rows_of("correctness")
    assert [row for row in rows if not row["ok"]] == []
    kinds = {row["of"].split(":")[0].split(",")[0] for row in rows}
    assert {
        "rasterizer",
        "L1 + D-SSIM",
        "total variation",
        "L_boltz",
        "losses of three steps",
    } <= kinds


def test_scenes_grow_and_have_all_kinds_of_layers():
    scenes = list(gpu_correctness.scenes(FULL))
    assert {scene.modalities for scene in scenes} >= {("rgb",), ("rgb", "thermal")}
    counts = [len(scene.tensors["means"]) for scene in scenes]
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (0, FULL.largest_scene[0])


def test_a_wrong_image_and_a_wrong_gradient_are_found(monkeypatch):
    right = gpu_workload.rasterize

    def wrong(means, *arguments):
        raster = right(2 * means - means.detach(), *arguments)
        blends = tuple(blend._replace(alpha=blend.alpha + 1e-3) for blend in raster.blends)
        return raster._replace(blends=blends)

    monkeypatch.setattr(gpu_workload, "rasterize", wrong)
    scene = gpu_workload.random_scene(3, 40, 37, 29, ("thermal",))
    found = {f["of"]: gpu_correctness.ok(f) for f in gpu_correctness.compare_rasterizer(scene, CPU)}
    assert [name for name, fine in found.items() if not fine] == [
        "rasterizer: thermal alpha",
        "rasterizer: gradient of means",
    ]


def test_nan_is_wrong_and_a_wrong_neighbour_is_found(monkeypatch):
    assert not gpu_correctness.ok({"error": math.nan, "limit": 1})
    assert gpu_correctness.ok({"error": 0.0, "limit": 0})
    monkeypatch.setattr(
        gpu_correctness, "nearest_neighbours", lambda means, k: torch.zeros(len(means), k).long()
    )
    (found,) = gpu_correctness.compare_neighbours(CPU, 50)
    assert not gpu_correctness.ok(found)


def test_sizes_are_measured_with_the_least_bytes_they_move():
    (row,) = rows_of("rasterizer")
    assert (row["gaussians"], row["width"], row["height"]) == TRIAL.sizes[0]
    assert row["times"].keys() == {"forward", "forward + backward"}
    assert row["least_bytes"] == 2 * 4 * (
        300 * 16 + 64 * 48 * 8
    )  # 16 numbers per Gaussian, 8 per pixel


def raising(error: Exception):
    def run(*_, **__):
        raise error

    return run


def test_a_size_that_does_not_fit_is_skipped():
    expected = {"gaussians": 1, "width": 2, "height": 3, "skipped": "out of memory"}
    assert gpu_stages._sized((1, 2, 3), raising(torch.cuda.OutOfMemoryError("no"))) == expected


def test_a_size_that_fails_leaves_the_others_alone(monkeypatch):
    def compare(clock, size, *_):
        if size[0] == 1:
            raise RuntimeError("CUDA error: invalid argument\nCompile with X to enable assertions.")
        return {"times": {}}

    monkeypatch.setattr(gpu_gsplat, "build", lambda: "1.5.3")
    monkeypatch.setattr(gpu_stages, "_compare", compare)
    plan = dataclasses.replace(TRIAL, sizes=((1, 8, 8), (2, 8, 8)))
    version, failed, measured = gpu_stages.beside_gsplat(gpu_stages.Order(plan, CPU, 0))
    assert version == {"gsplat": "1.5.3"}
    assert (
        failed["failed"]
        == "RuntimeError: CUDA error: invalid argument … Compile with X to enable assertions."
    )
    assert "in compare" in failed["traceback"]
    assert measured == {"gaussians": 2, "width": 8, "height": 8, "times": {}}


def test_a_comparison_that_fails_is_wrong_and_one_without_room_is_not(monkeypatch):
    monkeypatch.setattr(
        gpu_correctness, "compare_rasterizer", raising(torch.cuda.OutOfMemoryError("no"))
    )
    monkeypatch.setattr(gpu_correctness, "compare_neighbours", raising(ValueError()))
    rows = rows_of("correctness")
    skipped, failed = ([row for row in rows if kind in row] for kind in ("skipped", "failed"))
    assert {row["skipped"] for row in skipped} == {"out of memory"}
    assert skipped[0]["of"] == "rasterizer: 0 Gaussians, 7×6, rgb and thermal"
    assert [(row["of"], row["failed"]) for row in failed] == [
        ("neighbours among 3", "ValueError"),
        ("neighbours among 100", "ValueError"),
    ]
    assert len(skipped) == TRIAL.scenes
    assert [row for row in rows if not row["ok"]] == failed
    assert rows[-3]["of"] == "losses of twenty steps, replayed, mrgs-plus"
    assert rows[-1] == {
        "of": "kernels that a training of mrgs-plus rejects", "error": 0, "limit": 0,
        "warnings": [], "ok": True,
    }  # fmt: skip
    assert gpu.is_bad({"parts": {"correctness": {"rows": failed}}})
    assert not gpu.is_bad({"parts": {"correctness": {"rows": skipped}}})


def test_a_size_that_fails_ends_with_status_1():
    assert gpu.is_bad({"parts": {"gsplat": {"rows": [{"gaussians": 1, "failed": "ValueError"}]}}})


def test_whole_steps_of_both_methods():
    assert [(row["method"], row["steps_per_s"] > 0) for row in rows_of("step")] == [
        ("mrgs", True),
        ("mrgs-plus", True),
    ]


@pytest.mark.parametrize(
    ("effort", "expected"),
    [
        (Effort(runs=300, seconds=60, fewest=1, warm_up=0), 200),
        (Effort(runs=30, seconds=60, fewest=1, warm_up=0), 30),
        (Effort(runs=30, seconds=0, fewest=5, warm_up=0), 5),
    ],
)
def test_steps_per_second_come_from_many_steps(effort, expected):
    runs = []
    assert gpu_stages._per_second(Clock(CPU), lambda: runs.append(1), effort) > 0
    assert len(runs) == expected


def test_the_training_begins_only_if_time_for_the_scoring_is_left():
    assert gpu.LEAST_SECONDS["training"] > gpu_stages.EVALUATION_S


def test_the_full_run_trains_with_the_schedule_of_the_paper():
    assert make_config("mrgs", "paper", max_steps=FULL.training_steps) == make_config(
        "mrgs", "paper"
    )


def test_the_bundled_scene_is_trained_and_scored():
    trained, scored = rows_of("training")
    assert (trained["steps"], trained["of_steps"]) == (TRIAL.training_steps,) * 2
    assert scored["metrics"]["thermal mae_c"] > 0


def test_training_ends_when_the_time_is_up(monkeypatch):
    monkeypatch.setattr(gpu_stages, "EVALUATION_S", 1e9)
    trained, scored = rows_of("training")
    assert (trained["steps"], trained["of_steps"]) == (1, TRIAL.training_steps)
    assert "rgb psnr" in scored["metrics"]


def answer(
    monkeypatch, rows: list[dict], returncode: int = 0, stderr: str = "", late: bool = False
) -> list[str]:
    """Replaces the children, but for the device's, by one that writes these rows; returns the parts
    asked for."""
    asked = []

    def run(command, timeout, **_):
        request = json.loads(command[-1])
        asked.append(request["part"])
        with open(request["file"], "w") as file:
            json.dump(rows if request["part"] != "device" else [], file)
        if request["part"] == "device":
            return SimpleNamespace(returncode=0, stderr="")
        if late:
            raise subprocess.TimeoutExpired(command, timeout)
        return SimpleNamespace(returncode=returncode, stderr=stderr)

    monkeypatch.setattr(gpu.subprocess, "run", run)
    return asked


def run_gpu(tmp_path, *arguments: str) -> tuple[int, dict]:
    status = gpu.main(["--device", "cpu", "--output", str(tmp_path), *arguments])
    return status, json.loads((tmp_path / "gpu.json").read_text())["parts"]


def test_a_wrong_result_ends_with_status_1(monkeypatch, tmp_path):
    asked = answer(monkeypatch, [{"of": "image", "error": 0.5, "limit": 0.1, "ok": False}])
    assert run_gpu(tmp_path, "--only", "correctness")[0] == 1
    assert asked == ["device", "correctness"]
    assert "| image | 1 | 5.0e-01 | 1e-01 | **wrong** |" in (tmp_path / "gpu.md").read_text()


def test_a_part_that_fails_says_why_and_keeps_what_it_measured(monkeypatch, tmp_path, capsys):
    rows = [{"of": "image", "error": 0.0, "limit": 0.1, "ok": True}]
    answer(
        monkeypatch,
        rows,
        returncode=1,
        stderr="Traceback\nRuntimeError: an illegal memory access\n",
    )
    status, parts = run_gpu(tmp_path, "--only", "correctness")
    assert status == 1
    assert parts["correctness"]["rows"] == rows
    assert parts["correctness"]["failed"] == "RuntimeError: an illegal memory access"
    assert "Failed: RuntimeError: an illegal memory access." in (tmp_path / "gpu.md").read_text()


def test_a_part_that_takes_too_long_is_ended_and_keeps_what_it_measured(monkeypatch, tmp_path):
    rows = [{"of": "image", "error": 0.0, "limit": 0.1, "ok": True}]
    answer(monkeypatch, rows, late=True)
    status, parts = run_gpu(tmp_path, "--only", "correctness", "--seconds", "50")
    assert status == 0
    assert parts["correctness"]["rows"] == rows
    assert parts["correctness"]["skipped"].startswith("not done after ")


def test_parts_for_which_no_time_is_left_are_skipped(monkeypatch, tmp_path):
    asked = answer(monkeypatch, [])
    status, parts = run_gpu(tmp_path, "--only", "training", "--seconds", "20")
    assert (status, asked) == (0, ["device"])
    assert parts["training"]["skipped"] == "20 s of 20 s were left"
    assert parts["training"]["rows"] == []


def test_gsplat_needs_a_gpu(monkeypatch, tmp_path):
    answer(monkeypatch, [])
    assert run_gpu(tmp_path, "--only", "gsplat")[1]["gsplat"] == {"skipped": "needs a GPU"}


def test_what_an_earlier_run_measured_is_kept_with_its_device(monkeypatch, tmp_path):
    """Also where that run was wrong: only the parts that were asked for decide on the status."""
    device = {"device": "H200", "date": "2026-11-01", "torch": "2.11", "launch_s": 3e-6}
    wrong = {"rows": [{"of": "image", "error": 0.5, "limit": 0.1, "ok": False}]}
    earlier = {"plan": "trial", "parts": {"device": {"rows": [device]}, "correctness": wrong}}
    (tmp_path / "gpu.json").write_text(json.dumps(earlier))
    answer(monkeypatch, [])
    for _ in range(2):
        status, parts = run_gpu(tmp_path, "--only", "rasterizer")
        assert status == 0
        assert parts["correctness"] == {"device": [device], **wrong}
        assert "device" not in parts["rasterizer"]
    text = (tmp_path / "gpu.md").read_text()
    assert "From another run, 2026-11-01: H200, torch 2.11, one small operation" in text
    assert "in 3.0 µs.\n\n|  | cases |" in text


def test_nothing_is_kept_of_another_plan_or_without_only(monkeypatch, tmp_path):
    answer(monkeypatch, [])
    for plan, arguments in ("full", ["--only", "rasterizer"]), ("trial", []):
        earlier = {"plan": plan, "parts": {"device": {}, "correctness": {"rows": [{"of": "old"}]}}}
        (tmp_path / "gpu.json").write_text(json.dumps(earlier))
        assert "old" not in str(run_gpu(tmp_path, *arguments)[1])


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.slow
def test_without_a_gpu_nothing_is_measured_and_the_remedy_is_told(tmp_path):
    assert gpu.main(["--output", str(tmp_path), "--seconds", "60"]) == 1
    assert list(json.loads((tmp_path / "gpu.json").read_text())["parts"]) == ["device"]
    assert "DeviceError: " in (tmp_path / "gpu.md").read_text()


def test_a_wheel_is_unpacked_once_and_found_by_the_children(monkeypatch, tmp_path):
    monkeypatch.setattr(gpu.tempfile, "gettempdir", lambda: str(tmp_path))
    wheel = tmp_path / "gsplat-1.5.3-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("gsplat/__init__.py", "")
    folder = gpu._unpacked(wheel)
    assert (folder / "gsplat" / "__init__.py").exists()
    assert gpu._unpacked(wheel) == gpu._unpacked(folder) == folder
    assert str(folder) in gpu.environment(folder)["PYTHONPATH"].split(os.pathsep)
    assert gpu._unpacked(None) is None


def test_a_process_beside_the_parts_is_waited_for_and_ended(tmp_path):
    done = tmp_path / "done"
    with gpu.Beside(["-c", f"open({str(done)!r}, 'w')"], gpu.environment(None)) as short:
        assert short.done_within(60.0)
        assert done.exists()
    with gpu.Beside(["-c", "import time; time.sleep(600)"], gpu.environment(None)) as endless:
        assert not endless.done_within(0.0)
    assert endless.done_within(0.0)


def test_nothing_is_compiled_beside_what_is_timed(monkeypatch, tmp_path):
    """The comparison with the oracles, which is not timed, does not wait."""
    asked = answer(monkeypatch, [])
    waited_before = []

    class Compilation(AbstractContextManager):
        def done_within(self, seconds: float) -> bool:
            waited_before.append(list(asked))
            return True

        def __exit__(self, *_):
            return None

    monkeypatch.setattr(gpu, "scoring_compilation", lambda folder: Compilation())
    only = ["--only", "correctness", "--only", "step", "--only", "training"]
    assert gpu.main(["--output", str(tmp_path), *only]) == 0
    assert waited_before == [["device", "correctness"]]


def test_the_children_never_interpret_the_kernels(monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert "TRITON_INTERPRET" not in gpu.environment(None)


@pytest.mark.slow
def test_parts_run_without_what_a_bare_machine_lacks(tmp_path):
    """One part for real, from another folder, where the command line's and the viewer's packages
    are missing."""
    for name in ("tyro", "rich", "websockets", "pytest", "hypothesis", "beartype", "matplotlib"):
        (tmp_path / f"{name}.py").write_text(f"raise ImportError('{name} is missing')")
    environment = gpu.environment(None)
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), environment["PYTHONPATH"]])
    command = [sys.executable, "-m", "benchmarks.gpu", "--device", "cpu", "--only", "rasterizer"]
    run = subprocess.run(
        [*command, "--output", str(tmp_path / "out")],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    parts = json.loads((tmp_path / "out" / "gpu.json").read_text())["parts"]
    assert "skipped" not in parts["rasterizer"]
    assert parts["device"]["rows"][0]["device"] == "cpu"


def test_one_run_is_enough_for_a_summary():
    assert Clock(CPU).measure({"a": lambda: None}, ONE_RUN)["a"].runs == 1


def test_re_recording_costs_what_it_takes_beyond_its_steps(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(gpu_stages.time, "perf_counter", lambda: now[0])

    def takes(seconds: float) -> Callable[[], None]:
        def call() -> None:
            now[0] += seconds

        return call

    recorder = SimpleNamespace(forget=takes(0.2))
    found = gpu_stages._rerecord_ms(Clock(CPU), takes(0.003), recorder, 2.0)
    assert found == pytest.approx(200 + gpu_stages.RERECORD_STEPS * (3 - 2))
