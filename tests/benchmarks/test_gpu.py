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

from benchmarks import gpu, gpu_correctness, gpu_stages
from benchmarks.gpu_plan import FULL, TRIAL
from benchmarks.gpu_timing import Clock, PeakMemory, ceilings, host_waits, waits_among
from benchmarks.gpu_workload import RandomScene, random_scene
from benchmarks.plan import ONE_RUN, Effort
from mrgs.method.config import make_config
from mrgs.rasterizer import Raster

CPU = torch.device("cpu")


def rows_of(part: str, seconds: float = 600) -> list[dict]:
    return list(gpu_stages.PARTS[part](gpu_stages.Order(TRIAL, CPU, time.time() + seconds)))


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


def test_waits_of_the_host_are_counted_by_their_lines():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.warn(
            "Synchronization debug mode does not yet detect all synchronizing operations",
            stacklevel=1,
        )
        for _ in range(3):
            warnings.warn("called a synchronizing CUDA operation", stacklevel=1)
    ((line, count),) = waits_among(caught).items()
    assert line.startswith("tests/benchmarks/test_gpu.py:")
    assert count == 3


def test_nothing_waits_and_no_memory_is_taken_without_a_gpu():
    if torch.cuda.is_available():
        pytest.skip("there is one")
    assert host_waits(lambda: 1) == {}
    assert PeakMemory(CPU).nbytes() is None


def test_the_cpu_kernels_pass_every_comparison():
    rows = rows_of("correctness")
    assert [row for row in rows if not row["ok"]] == []
    kinds = {row["of"].split(":")[0].split(",")[0] for row in rows}
    assert kinds >= {"rasterizer", "L_boltz"}
    assert any(row["of"].startswith("kernels") and row["limit"] == 0 for row in rows)


def test_scenes_grow_and_have_all_kinds_of_layers():
    scenes = list(gpu_correctness.scenes(FULL))
    assert {scene.modalities for scene in scenes} >= {("rgb",), ("rgb", "thermal")}
    counts = [len(scene.tensors["means"]) for scene in scenes]
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (0, FULL.largest_scene[0])


def test_no_rounding_swaps_two_gaussians_of_a_scene():
    scene = random_scene(1, 300, 37, 29, ("rgb",))
    turned = scene.tensors["means"] @ scene.viewmat[:3, :3].T
    distances = (turned + scene.viewmat[:3, 3]).norm(dim=1).sort().values
    assert distances.diff().min() > 1e-3


class WronglyRendered(RandomScene):
    """All but its oracle's images: α is off, and so is the gradient of the means."""

    def render(self, oracle: bool = False) -> Raster:
        if oracle:
            return super().render(oracle)
        means = self.tensors["means"]
        tensors = {**self.tensors, "means": 2 * means - means.detach()}
        raster = RandomScene.render(dataclasses.replace(self, tensors=tensors), oracle=True)
        blends = tuple(blend._replace(alpha=blend.alpha + 1e-3) for blend in raster.blends)
        return raster._replace(blends=blends)


def test_a_wrong_image_and_a_wrong_gradient_are_found():
    scene = WronglyRendered(**vars(random_scene(3, 40, 37, 29, ("thermal",))))
    found = {f["of"]: gpu_correctness.ok(f) for f in gpu_correctness.compare_rasterizer(scene, CPU)}
    alpha, means = [name for name, fine in found.items() if not fine]
    assert alpha.endswith("thermal alpha")
    assert means.endswith("means")


def test_nan_is_wrong_and_a_wrong_neighbour_is_found():
    assert not gpu_correctness.ok({"error": math.nan, "limit": 1})
    assert gpu_correctness.ok({"error": 0.0, "limit": 0})

    def first(means: torch.Tensor, k: int) -> torch.Tensor:
        return torch.zeros(len(means), k).long()

    (found,) = gpu_correctness.compare_neighbours(CPU, 50, search=first)
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


def test_a_size_that_fails_leaves_the_others_alone():
    plan = dataclasses.replace(TRIAL, sizes=((1, 8, -8), (2, 8, 8)))
    failed, measured = gpu_stages.rasterizer(gpu_stages.Order(plan, CPU, 0))
    assert (failed["gaussians"], failed["height"]) == (1, -8)
    assert "8×-8" in failed["failed"]
    assert "in _fused_pass" in failed["traceback"]
    assert "failed" not in measured
    assert measured["gaussians"] == 2


def test_of_a_long_message_the_first_line_and_the_last_are_kept():
    error = RuntimeError("CUDA error\nin between\nCompile it")
    kept = gpu_stages._sized((1, 2, 3), raising(error))["failed"]
    assert kept == "RuntimeError: CUDA error … Compile it"


def test_a_comparison_that_fails_is_wrong_and_one_without_room_is_not():
    (failed,) = gpu_correctness.attempt("image", raising(ValueError()))
    (skipped,) = gpu_correctness.attempt("loss", raising(torch.cuda.OutOfMemoryError("no")))
    assert (failed["of"], failed["failed"]) == ("image", "ValueError")
    assert (skipped["of"], skipped["skipped"]) == ("loss", "out of memory")
    for finding, wrong in (failed, True), (skipped, False):
        row = {**finding, "ok": gpu_correctness.ok(finding)}
        assert row["ok"] is not wrong
        assert gpu.is_bad({"parts": {"correctness": {"rows": [row]}}}) is wrong


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


def test_training_ends_when_the_time_is_up():
    trained, scored = rows_of("training", seconds=0)
    assert (trained["steps"], trained["of_steps"]) == (1, TRIAL.training_steps)
    assert "rgb psnr" in scored["metrics"]


@dataclasses.dataclass
class Children:
    """In place of the processes: all but the device's leave the same rows and end alike.

    Attributes:
        asked: the parts that they were started for.
    """

    rows: list[dict] = dataclasses.field(default_factory=list)
    returncode: int = 0
    stderr: str = ""
    late: bool = False
    asked: list[str] = dataclasses.field(default_factory=list)

    def __call__(self, command, timeout, **_) -> subprocess.CompletedProcess[str]:
        request = json.loads(command[-1])
        self.asked.append(request["part"])
        of_device = request["part"] == "device"
        with open(request["file"], "w") as file:
            json.dump([] if of_device else self.rows, file)
        if of_device:
            return subprocess.CompletedProcess(command, 0, stderr="")
        if self.late:
            raise subprocess.TimeoutExpired(command, timeout)
        return subprocess.CompletedProcess(command, self.returncode, stderr=self.stderr)


def run_gpu(tmp_path, children: Children, *arguments: str) -> tuple[int, dict]:
    status = gpu.main(["--device", "cpu", "--output", str(tmp_path), *arguments], children)
    return status, json.loads((tmp_path / "gpu.json").read_text())["parts"]


GOOD = {"of": "image", "error": 0.0, "limit": 0.1, "ok": True}
WRONG = {"of": "image", "error": 0.5, "limit": 0.1, "ok": False}


def test_a_wrong_result_ends_with_status_1(tmp_path):
    children = Children([WRONG])
    assert run_gpu(tmp_path, children, "--only", "correctness")[0] == 1
    assert children.asked == ["device", "correctness"]
    assert "**wrong**" in (tmp_path / "gpu.md").read_text()


def test_a_part_that_fails_says_why_and_keeps_what_it_measured(tmp_path):
    failing = Children([GOOD], returncode=1, stderr="Traceback\nRuntimeError: illegal access\n")
    status, parts = run_gpu(tmp_path, failing, "--only", "correctness")
    assert status == 1
    assert parts["correctness"]["rows"] == [GOOD]
    assert parts["correctness"]["failed"] == "RuntimeError: illegal access"
    assert "RuntimeError: illegal access" in (tmp_path / "gpu.md").read_text()


def test_a_part_that_takes_too_long_is_ended_and_keeps_what_it_measured(tmp_path):
    late = Children([GOOD], late=True)
    status, parts = run_gpu(tmp_path, late, "--only", "correctness", "--seconds", "50")
    assert status == 0
    assert parts["correctness"]["rows"] == [GOOD]
    assert "not done" in parts["correctness"]["skipped"]


def test_parts_for_which_no_time_is_left_are_skipped(tmp_path):
    children = Children()
    status, parts = run_gpu(tmp_path, children, "--only", "training", "--seconds", "20")
    assert (status, children.asked) == (0, ["device"])
    assert "20 s" in parts["training"]["skipped"]
    assert parts["training"]["rows"] == []


def test_gsplat_needs_a_gpu(tmp_path):
    _, parts = run_gpu(tmp_path, Children(), "--only", "gsplat")
    assert "GPU" in parts["gsplat"]["skipped"]


def test_what_an_earlier_run_measured_is_kept_with_its_device(tmp_path):
    """Also where that run was wrong: only the parts that were asked for decide on the status."""
    device = {"device": "H200", "date": "2026-11-01", "torch": "2.11", "launch_s": 3e-6}
    wrong = {"rows": [WRONG]}
    earlier = {"plan": "trial", "parts": {"device": {"rows": [device]}, "correctness": wrong}}
    (tmp_path / "gpu.json").write_text(json.dumps(earlier))
    for _ in range(2):
        status, parts = run_gpu(tmp_path, Children(), "--only", "rasterizer")
        assert status == 0
        assert parts["correctness"] == {"device": [device], **wrong}
        assert "device" not in parts["rasterizer"]
    text = (tmp_path / "gpu.md").read_text()
    for fact in ("2026-11-01", "H200", "torch 2.11", "3.0 µs"):
        assert fact in text


def test_nothing_is_kept_of_another_plan_or_without_only(tmp_path):
    for plan, arguments in ("full", ["--only", "rasterizer"]), ("trial", []):
        earlier = {"plan": plan, "parts": {"device": {}, "correctness": {"rows": [{"of": "old"}]}}}
        (tmp_path / "gpu.json").write_text(json.dumps(earlier))
        assert "old" not in str(run_gpu(tmp_path, Children(), *arguments)[1])


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.slow
def test_without_a_gpu_nothing_is_measured_and_the_remedy_is_told(tmp_path):
    assert gpu.main(["--output", str(tmp_path), "--seconds", "60"]) == 1
    assert list(json.loads((tmp_path / "gpu.json").read_text())["parts"]) == ["device"]
    assert "DeviceError: " in (tmp_path / "gpu.md").read_text()


def test_a_wheel_is_unpacked_once_and_found_by_the_children(tmp_path):
    wheel = tmp_path / "gsplat-1.5.3-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("gsplat/__init__.py", "")
    folder = gpu._unpacked(wheel, tmp_path)
    assert (folder / "gsplat" / "__init__.py").exists()
    assert gpu._unpacked(wheel, tmp_path) == gpu._unpacked(folder) == folder
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


def test_nothing_is_compiled_beside_what_is_timed(tmp_path):
    """The comparison with the oracles, which is not timed, does not wait."""
    children = Children()
    waited_before = []

    class Compilation(AbstractContextManager):
        def done_within(self, seconds: float) -> bool:
            waited_before.append(list(children.asked))
            return True

        def __exit__(self, *_):
            return None

    only = ["--only", "correctness", "--only", "step", "--only", "training"]
    arguments = ["--output", str(tmp_path), *only]
    assert gpu.main(arguments, children, lambda folder: Compilation()) == 0
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


def test_re_recording_costs_what_it_takes_beyond_its_steps():
    now = [0.0]

    def takes(seconds: float) -> Callable[[], None]:
        def call() -> None:
            now[0] += seconds

        return call

    recorder = SimpleNamespace(forget=takes(0.2))
    found = gpu_stages._rerecord_ms(Clock(CPU), takes(0.003), recorder, 2.0, now=lambda: now[0])
    assert found == pytest.approx(200 + gpu_stages.RERECORD_STEPS * (3 - 2))
