from __future__ import annotations

import re
import subprocess
import sys
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


def test_what_a_training_left_is_compiled(monkeypatch):
    """In this process or an earlier one: what has been called is on disk."""
    config = make_config("mrgs-plus", "fast")
    compiled = [name for name in compilation._needed(config) if compilation._is_saved(name)]
    monkeypatch.setattr(compilation, "_is_saved", lambda name: name in compiled[:2])
    found = compiling_progress(config)
    assert (found.done, found.total) == (min(2, len(compiled)), len(compilation._needed(config)))
    expected = sum(compilation._needed(config)[name] for name in compiled[:2])
    assert found.seconds_left == pytest.approx(sum(compilation._needed(config).values()) - expected)


def test_the_countdown_goes_by_the_pace(monkeypatch):
    left = iter(
        [
            CompilingProgress(0, 14, 30.0),
            CompilingProgress(0, 14, 30.0),
            CompilingProgress(7, 14, 12.0),
        ]
    )
    monkeypatch.setattr(
        compilation, "compiling_progress", lambda config: next(left, CompilingProgress(14, 14, 0.0))
    )
    clock = [0.0]
    monkeypatch.setattr(compilation.time, "monotonic", lambda: clock[0])
    countdown = Countdown(make_config("mrgs"))
    assert countdown.text == "compiling kernels 0/14, about 15 s left"
    clock[0] = 9.0
    assert countdown.text == "compiling kernels 7/14, about 6 s left"
    assert countdown.text is None


@pytest.mark.parametrize(("threads", "left", "starts"), [(1, 9.0, 0), (2, 0.0, 0), (2, 9.0, 1)])
def test_another_process_helps_where_there_is_a_core_and_something_to_do(
    monkeypatch, threads, left, starts
):
    started: list[object] = []

    class Stub:
        def __init__(self, arguments, request, log):
            started.append(request["config"])

        def close(self):
            started.append("closed")

    monkeypatch.setattr(compilation, "Child", Stub)
    monkeypatch.setattr(
        compilation, "compiling_progress", lambda config: CompilingProgress(0, 1, left)
    )
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    config = make_config("mrgs")
    with shared_compiling(config):
        assert started == [write_yaml(config)] * starts
    assert started == [write_yaml(config), "closed"] * starts


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
