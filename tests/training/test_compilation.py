from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module

import pytest
import torch
from numba.extending import is_jitted

from mrgs.method.config import make_config
from mrgs.system.child import Child
from mrgs.system.strict_yaml import write_yaml
from mrgs.training import compilation
from mrgs.training.compilation import (
    CHILD,
    CompilingProgress,
    Countdown,
    compiling_progress,
    shared_compiling,
)

METHODS = ["mrgs-plus", "mrgs", "3dgs-rgbt"]


@pytest.mark.parametrize("method", METHODS)
def test_every_kernel_that_is_counted_exists(method):
    found = compiling_progress(make_config(method, "fast"))
    assert found.total >= 11
    assert 0 <= found.done <= found.total


def test_the_published_field_needs_more():
    totals = [compiling_progress(make_config(method, "fast")).total for method in METHODS]
    assert totals[1] > totals[0] > totals[2]


def test_what_lies_compiled_need_not_be_waited_for():
    config = make_config("mrgs-plus", "fast")
    needed = compilation._needed(config)
    saved = list(needed)[3:5]
    found = compiling_progress(config, is_saved=saved.__contains__)
    assert (found.done, found.total) == (2, len(needed))
    rest = sum(seconds for name, seconds in needed.items() if name not in saved)
    assert found.seconds_left == pytest.approx(rest)


def test_the_countdown_goes_by_the_pace():
    left = iter(
        [
            CompilingProgress(0, 14, 30.0),
            CompilingProgress(0, 14, 30.0),
            CompilingProgress(7, 14, 12.0),
            CompilingProgress(14, 14, 0.0),
        ]
    )
    seconds = [0.0]
    countdown = Countdown(make_config("mrgs"), lambda config: next(left), lambda: seconds[0])
    assert re.findall(r"\d+", countdown.text) == ["0", "14", "15"]
    seconds[0] = 9.0
    assert re.findall(r"\d+", countdown.text) == ["7", "14", "6"]
    assert countdown.text is None


@pytest.fixture
def set_threads() -> Iterator[Callable[[int], None]]:
    """torch's number of threads, for the length of a test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize(("threads", "left", "starts"), [(1, 9.0, 0), (2, 0.0, 0), (2, 9.0, 1)])
def test_another_process_helps_where_there_is_a_core_and_something_to_do(
    threads, left, starts, set_threads
):
    started: list[object] = []

    class Stub:
        def __init__(self, arguments, request, log):
            started.append(request["config"])

        def close(self):
            started.append("closed")

    set_threads(threads)
    config = make_config("mrgs")
    with shared_compiling(config, lambda config: CompilingProgress(0, 1, left), Stub):
        assert started == [write_yaml(config)] * starts
    assert started == [write_yaml(config), "closed"] * starts


@pytest.mark.slow
def test_the_child_compiles_half_and_ends_with_its_parent(tmp_path):
    config = make_config("mrgs-plus", "fast")
    child = Child(CHILD, {"config": write_yaml(config)}, tmp_path / "log")
    assert list(child.messages()) == []
    assert child.failure() is None
    assert child.end == {"end": "compiled"}
    saved = [name for name in compilation._needed(config) if compilation._is_saved(name)]
    assert {"ssim.compare_cpu.compare", "harmonics.cpu._forward"} <= set(saved)
    child.close()


def test_a_child_whose_parent_dies_stops():
    request = '{"config": "method: mrgs"}'
    process = subprocess.run(
        [sys.executable, *CHILD, request], stdin=subprocess.DEVNULL, timeout=300, check=False
    )
    assert process.returncode == 0


def test_names_are_of_kernels():
    for name in compilation._needed(make_config("mrgs", "fast")):
        module, _, function = name.rpartition(".")
        assert is_jitted(getattr(import_module(f"mrgs.kernels.{module}"), function)), name
        assert re.fullmatch(r"[a-z_0-9.]+", name)
