"""What holds for every test: quiet threads, checked shapes, a device."""

from __future__ import annotations

import gc
import logging
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mrgs.scene import Modality

os.environ.setdefault(
    "OMP_WAIT_POLICY", "PASSIVE"
)  # before torch is loaded: spinning threads starve each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # nor do small matrices gain by threads

import pytest
from hypothesis import settings

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # started in the background by a shell
    signal.signal(signal.SIGINT, signal.default_int_handler)  # tests press Ctrl-C

# The same examples on every machine, and no verdict from how busy it is.
settings.register_profile("whole", deadline=None, derandomize=True)
settings.register_profile("short", settings.get_profile("whole"), max_examples=50)


def pytest_configure(config: pytest.Config) -> None:
    """Where tests run, and not in the process that only hands them out."""
    if getattr(config.option, "numprocesses", None):
        return
    settings.load_profile("short" if config.option.markexpr == "not slow" else "whole")
    import torch

    # Else pytest would add a handler to some forty loggers of torch in each phase of each test.
    for logger in logging.Logger.manager.loggerDict.values():
        if isinstance(logger, logging.Logger):
            logger.propagate = True
    if not torch.cuda.is_available():  # before Triton is loaded: its kernels then run on the CPU
        os.environ.setdefault("TRITON_INTERPRET", "1")
    if os.environ.get("CHECK_ARRAYS"):  # a fifth of the time: `make test-all` sets it
        from tests.helpers.array_checks import check_arrays

        check_arrays()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """What is collected stays until the end: no search for garbage looks at it."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


SLOW_FOLDERS = ("benchmarks", "synth")
"""Tests of what is not shipped: they run with `make test-all`."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Without the slow tests, does not even import what is only slow."""
    in_tests = collection_path.parent == Path(__file__).parent
    slow = in_tests and collection_path.name in SLOW_FOLDERS
    return True if slow and config.option.markexpr == "not slow" else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Without a GPU, leaves out what needs one, and counts interpreted kernels as slow."""
    import torch

    tests = Path(__file__).parent
    has_gpu = torch.cuda.is_available()
    for item in items:
        interpreted = not has_gpu and "gpu_device" in getattr(item, "fixturenames", ())
        if interpreted or item.path.relative_to(tests).parts[0] in SLOW_FOLDERS:
            item.add_marker(pytest.mark.slow)
        if not has_gpu and item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture(autouse=True, scope="session")
def auto_is_the_cpu() -> Iterator[None]:
    """With a GPU, too, a test runs on the CPU unless it says otherwise: many compare bits."""
    from mrgs.system import gpu

    choose = gpu.choose_device
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gpu, "choose_device", lambda name: choose("cpu" if name == "auto" else name))
        yield


@pytest.fixture(autouse=True, scope="session")
def hub_is_empty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Scores do not depend on the weights of LPIPS that somebody keeps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_HOME", str(tmp_path_factory.mktemp("torch")))
        yield


@pytest.fixture(scope="session")
def compare_once() -> Callable[..., None]:
    from mrgs.system.operation import Operation
    from tests.helpers.kernel_checks import once_per_form

    return once_per_form(Operation._compare)


@pytest.fixture(autouse=True)
def kernels_are_compared_once(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, compare_once: Callable
) -> None:
    """Else a training of three steps would spend most of its time on comparing the same kernels
    of the same shapes again. Tests of the comparison itself are marked ``compares_kernels``."""
    if request.node.get_closest_marker("compares_kernels") is None:
        from mrgs.system.operation import Operation

        monkeypatch.setattr(Operation, "_compare", compare_once)


@pytest.fixture
def gpu_device() -> Iterator[str]:
    """Where the Triton kernels run: "cuda"; or, without a CUDA device, "cpu", where they are
    interpreted."""
    import torch

    pytest.importorskip("triton")
    if torch.cuda.is_available():
        yield "cuda"
        return
    from mrgs.system import gpu

    with gpu.interpreted():
        yield "cpu"


@pytest.fixture(scope="session")
def counting_image() -> type:
    from tests.helpers.views import CountingImage

    return CountingImage


@pytest.fixture
def near_infrared(monkeypatch: pytest.MonkeyPatch) -> Modality:
    """A third modality, known for the length of a test."""
    from mrgs.scene import modality
    from tests.helpers.gaussians import NEAR_INFRARED

    monkeypatch.setattr(modality, "_known", dict(modality._known))
    return modality.register_modality(NEAR_INFRARED)


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both modalities through one camera; only to be read."""
    from tests.helpers.runs import made_once
    from tests.helpers.scenes import write_scene

    return made_once(tmp_path_factory, "balls", write_scene)


@pytest.fixture
def make_scene(tmp_path: Path) -> Callable[..., Path]:
    """Writes a scene of its own into the test's folder: ``make_scene(rgb=..., thermal=...,
    two_cameras=...)``."""
    from tests.helpers.scenes import write_scene

    return lambda **options: write_scene(tmp_path / "scene", **options)
