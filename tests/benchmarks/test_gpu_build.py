"""gpu.GsplatBuild: gsplat's kernels are built beside the first parts, or it is told why not."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from benchmarks import gpu


def build_with(monkeypatch, command: str) -> gpu.GsplatBuild:
    """The build, replaced by a command of its own."""
    start = subprocess.Popen
    monkeypatch.setattr(
        gpu.subprocess,
        "Popen",
        lambda _, **options: start([sys.executable, "-c", command], **options),
    )
    return gpu.GsplatBuild(None)


def held(pipe: int) -> bool:
    """Whether a process has the other end of an empty pipe."""
    try:
        return os.read(pipe, 1) != b""
    except BlockingIOError:
        return True


def wait_until(condition) -> None:
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (
            "raise ImportError('no CUDA compiler')",
            "gsplat cannot be used (ImportError: no CUDA compiler)",
        ),
        ("pass", None),
        (
            "raise RuntimeError('Error building extension: [1/2] nvcc -o a.o\\n'"
            "'a.cu(3): error: identifier \"x\" is undefined\\n  throw error: x\\n'"
            "'nvcc fatal   : no room\\nninja: build stopped: subcommand failed.')",
            'gsplat cannot be used (a.cu(3): error: identifier "x" is undefined; nvcc fatal   : '
            "no room)",
        ),
    ],
)
def test_gsplat_that_cannot_be_built_is_left_out_with_the_reason(monkeypatch, command, reason):
    with build_with(monkeypatch, command) as build:
        assert build.wait(60) == reason


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="POSIX alone")
def test_a_build_that_takes_too_long_is_ended(monkeypatch):
    with build_with(monkeypatch, "import time; time.sleep(600)") as build:
        assert build.wait(0) == (
            "gsplat's kernels were not built in time: build them first "
            "(PYTHONPATH=src python -m benchmarks.gpu_gsplat), then run this again on the same "
            "machine"
        )
        assert build._process.poll() is not None
    assert build._process.returncode != 0


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="POSIX alone")
def test_a_build_that_does_not_end_when_asked_is_killed(monkeypatch, tmp_path):
    monkeypatch.setattr(gpu, "END_SECONDS", 0.1)
    deaf = tmp_path / "deaf"
    command = (
        "import pathlib, signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
        f"pathlib.Path({str(deaf)!r}).touch(); time.sleep(600)"
    )
    build = build_with(monkeypatch, command)
    wait_until(deaf.exists)
    build.wait(0)
    assert build._process.returncode == -signal.SIGKILL


@pytest.mark.skipif(
    shutil.which("ninja") is None or not hasattr(os, "mkfifo"), reason="needs ninja and POSIX"
)
def test_the_compilers_of_a_build_are_ended_with_it(monkeypatch, tmp_path):
    """ninja gives them groups of their own; one that lives holds the pipe's end that it writes
    to."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "build.ninja").write_text(
        "rule compile\n  command = exec sleep 600 > pipe\nbuild a.o: compile\n"
    )
    pipe = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    command = (
        f"import subprocess; subprocess.run(['ninja', '-C', {str(tmp_path)!r}], "
        f"stdout=subprocess.PIPE)"
    )
    try:
        with build_with(monkeypatch, command) as build:
            wait_until(lambda: held(pipe))
            build.wait(0)
            wait_until(lambda: not held(pipe))
    finally:
        os.close(pipe)


def test_the_remedy_names_the_folder_of_the_wheel(monkeypatch, tmp_path):
    start = subprocess.Popen
    jobs = []

    def popen(_, env, **options):
        jobs.append(int(env["MAX_JOBS"]))
        return start([sys.executable, "-c", "import time; time.sleep(600)"], env=env, **options)

    monkeypatch.setattr(gpu.subprocess, "Popen", popen)
    monkeypatch.setattr(gpu.os, "cpu_count", lambda: 16)
    with gpu.GsplatBuild(tmp_path) as build:
        assert (
            f"PYTHONPATH=src{os.pathsep}{tmp_path} python -m benchmarks.gpu_gsplat" in build.wait(0)
        )
    assert jobs == [14]
