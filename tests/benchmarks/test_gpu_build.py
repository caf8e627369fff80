"""gpu.GsplatBuild: gsplat's kernels are built beside the first parts, or it is told why not."""

from __future__ import annotations

import os
import shutil
import signal
import time
from pathlib import Path

import pytest

from benchmarks import gpu

ENDLESS = "import time; time.sleep(600)"


def build_with(command: str, source: Path | None = None) -> gpu.GsplatBuild:
    """The build, replaced by a command of its own."""
    return gpu.GsplatBuild(source, ["-c", command])


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


def test_gsplat_that_can_be_built_has_a_compiler_to_do_it_with():
    with build_with("import os; assert int(os.environ['MAX_JOBS']) > 0") as build:
        assert build.wait(60) is None


def test_gsplat_that_cannot_be_built_is_left_out_with_the_reason():
    with build_with("raise ImportError('no compiler')") as build:
        assert "(ImportError: no compiler)" in build.wait(60)


def test_of_what_compilers_say_their_errors_are_the_reason():
    said = (
        "Traceback\nError building extension: [1/2] nvcc -o a.o\n"
        "a.cu(3): error: undefined\n  throw error: x\nnvcc fatal: no room\n"
        "ninja: build stopped: subcommand failed.\n"
    )
    assert gpu.reason(said, 1) == "a.cu(3): error: undefined; nvcc fatal: no room"


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="POSIX alone")
def test_a_build_that_takes_too_long_is_ended_and_the_remedy_told(tmp_path):
    with build_with(ENDLESS, source=tmp_path) as build:
        remedy = build.wait(0)
        assert f"src{os.pathsep}{tmp_path}" in remedy
        assert "benchmarks.gpu_gsplat" in remedy
        assert build._process.poll() is not None
    assert build._process.returncode != 0


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="POSIX alone")
def test_a_build_that_does_not_end_when_asked_is_killed(tmp_path):
    deaf = tmp_path / "deaf"
    command = (
        "import pathlib, signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
        f"pathlib.Path({str(deaf)!r}).touch(); time.sleep(600)"
    )
    build = build_with(command)
    wait_until(deaf.exists)
    build.stop(patience_s=0.1)
    assert build._process.returncode == -signal.SIGKILL


@pytest.mark.skipif(
    shutil.which("ninja") is None or not hasattr(os, "mkfifo"), reason="needs ninja and POSIX"
)
def test_the_compilers_of_a_build_are_ended_with_it(tmp_path):
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
        with build_with(command) as build:
            wait_until(lambda: held(pipe))
            build.wait(0)
            wait_until(lambda: not held(pipe))
    finally:
        os.close(pipe)
