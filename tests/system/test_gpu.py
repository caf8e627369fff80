from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

import pytest
import torch

from mrgs.errors import DeviceError, MrgsWarning
from mrgs.system import gpu
from mrgs.system.gpu import lacks_memory

choose_device = gpu.choose_device  # before the tests' own, which takes the CPU for "auto"


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    """A machine with a GPU on which everything is right."""
    (tmp_path / "Python.h").touch()
    monkeypatch.setattr(gpu.sysconfig, "get_default_scheme", lambda: "venv")
    monkeypatch.setattr(gpu.sysconfig, "get_paths", lambda scheme: {"include": str(tmp_path)})
    monkeypatch.delenv("CPATH", raising=False)
    monkeypatch.delenv("C_INCLUDE_PATH", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda *_: "NVIDIA H200")
    monkeypatch.setattr(gpu, "_has_triton", lambda: True)
    monkeypatch.setattr(gpu, "_triton_version", lambda: "3.4.0")
    monkeypatch.setattr(gpu, "_driver_is_installed", lambda: True)
    monkeypatch.setenv("CC", "gcc")
    return monkeypatch


def without_driver(machine: pytest.MonkeyPatch) -> str:
    fail(machine, "Found no NVIDIA driver on your system. Please check that you have an NVIDIA GPU")
    machine.setattr(gpu, "_driver_is_installed", lambda: False)
    return "no NVIDIA driver was found: install it from https://www.nvidia.com/drivers"


def with_old_driver(machine: pytest.MonkeyPatch) -> str:
    fail(machine, "The NVIDIA driver on your system is too old (found version 11040)")
    return (
        "the NVIDIA driver is too old for this torch, which was built for CUDA 12.8: "
        "install a newer driver, or a torch for an older CUDA"
    )


def with_hidden_gpu(machine: pytest.MonkeyPatch) -> str:
    fail(machine, "No CUDA GPUs are available")
    return "no usable NVIDIA GPU was found: check `nvidia-smi` and CUDA_VISIBLE_DEVICES"


def with_cpu_torch(machine: pytest.MonkeyPatch) -> str:
    machine.setattr(torch.version, "cuda", None)
    machine.setattr(torch, "__version__", "2.13.0+cpu")
    return "this torch (2.13.0+cpu) is built without CUDA: pip install --force-reinstall torch"


def with_cpu_torch_on_windows(machine: pytest.MonkeyPatch) -> str:
    machine.setattr(sys, "platform", "win32")
    return f"{with_cpu_torch(machine)} --index-url https://download.pytorch.org/whl/cu128"


def with_old_gpu(machine: pytest.MonkeyPatch) -> str:
    machine.setattr(torch.cuda, "get_device_capability", lambda: (6, 1))
    machine.setattr(torch.cuda, "get_device_name", lambda *_: "GTX 1080")
    return "the GTX 1080 is too old: it has compute capability 6.1, and 7.5 or newer is needed"


def without_triton(machine: pytest.MonkeyPatch) -> str:
    machine.setattr(gpu, "_has_triton", lambda: False)
    return "Triton is missing: pip install triton"


def without_triton_on_windows(machine: pytest.MonkeyPatch) -> str:
    machine.setattr(sys, "platform", "win32")
    return f"{without_triton(machine)}-windows"


def with_old_triton(machine: pytest.MonkeyPatch) -> str:
    machine.setattr(gpu, "_triton_version", lambda: "3.3.1+gitc8757738")
    return (
        "Triton 3.3.1+gitc8757738 is too old: 3.4 or newer is needed, which comes with torch 2.8: "
        "pip install --upgrade torch"
    )


def without_compiler(machine: pytest.MonkeyPatch) -> str:
    machine.delenv("CC")
    machine.setattr(gpu.shutil, "which", lambda name: None)
    return (
        "Triton needs a C compiler, once, to start its kernels: install gcc or clang, or name "
        "one in CC"
    )


def without_headers(machine: pytest.MonkeyPatch) -> str:
    machine.setattr(gpu.sysconfig, "get_paths", lambda scheme: {"include": "/nowhere"})
    return (
        f"Triton needs Python's C headers, once, to start its kernels, but there is no "
        f"{Path('/nowhere/Python.h')}: "
        "install python3-dev (python3-devel on Fedora)"
    )


def with_gpu_that_does_not_start(machine: pytest.MonkeyPatch) -> str:
    def capability() -> tuple[int, int]:
        raise RuntimeError(
            "CUDA error: initialization error\nCUDA kernel errors might be reported later\n"
        )

    machine.setattr(torch.cuda, "get_device_capability", capability)
    return "the GPU cannot be started: CUDA error: initialization error"


def fail(machine: pytest.MonkeyPatch, reason: str) -> None:
    """CUDA does not start."""

    def init() -> None:
        raise RuntimeError(reason)

    machine.setattr(torch.cuda, "is_available", lambda: False)
    machine.setattr(torch.cuda, "init", init)


OBSTACLES = [
    without_driver, with_old_driver, with_hidden_gpu, with_cpu_torch, with_cpu_torch_on_windows,
    with_old_gpu,
    without_triton, without_triton_on_windows, with_old_triton, without_compiler, without_headers,
    with_gpu_that_does_not_start,
]  # fmt: skip


@pytest.mark.parametrize("obstacle", OBSTACLES)
def test_a_gpu_that_cannot_be_used_is_refused_with_what_would_mend_it(obstacle, machine):
    reason = obstacle(machine)
    with pytest.raises(DeviceError) as caught:
        choose_device("cuda")
    assert str(caught.value) == f"{reason}; or use the CPU"


@pytest.mark.parametrize("obstacle", [each for each in OBSTACLES if each is not without_driver])
def test_auto_says_once_why_a_gpu_that_is_there_is_not_used(obstacle, machine):
    reason = obstacle(machine)
    with pytest.warns(MrgsWarning) as caught:
        assert choose_device("auto") == torch.device("cpu")
    assert [str(each.message) for each in caught] == [f"the NVIDIA GPU is not used: {reason}"]


@pytest.mark.parametrize("obstacle", [without_driver, with_cpu_torch])
def test_auto_is_quiet_where_there_is_no_gpu(obstacle, machine):
    obstacle(machine)
    machine.setattr(gpu, "_driver_is_installed", lambda: False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert choose_device("auto") == torch.device("cpu")


def test_headers_are_looked_for_where_triton_does_on_debian(machine, tmp_path):
    folders = {"posix_local": "/usr/local/include", "posix_prefix": str(tmp_path)}
    machine.setattr(gpu.sysconfig, "get_default_scheme", lambda: "posix_local")
    machine.setattr(gpu.sysconfig, "get_paths", lambda scheme: {"include": folders[scheme]})
    assert choose_device("cuda").type == "cuda"


@pytest.mark.parametrize("name", ["CPATH", "C_INCLUDE_PATH"])
def test_headers_may_be_where_the_compiler_is_told(name, machine, tmp_path):
    without_headers(machine)
    machine.setenv(name, f"/elsewhere{os.pathsep}{tmp_path}")
    assert choose_device("cuda").type == "cuda"


def test_on_windows_triton_brings_its_own_headers(machine):
    without_headers(machine)
    machine.setattr(sys, "platform", "win32")
    assert choose_device("cuda").type == "cuda"


def test_there_is_no_cuda_on_a_mac(machine):
    machine.setattr(sys, "platform", "darwin")
    with pytest.raises(DeviceError, match=r"^there is no CUDA for macOS; or use the CPU$"):
        choose_device("cuda")


@pytest.mark.parametrize("version", ["3.4.0", "3.10.0", "4.0", None])
def test_newer_versions_of_triton_and_unknown_ones_are_tried(version, machine):
    machine.setattr(gpu, "_triton_version", lambda: version)
    assert choose_device("cuda").type == "cuda"


def test_a_gpu_that_can_be_used_is_used_unless_the_cpu_is_asked_for(machine):
    assert choose_device("auto") == choose_device("cuda") == torch.device("cuda", 0)
    assert choose_device("cpu") == torch.device("cpu")
    assert gpu.device_title(torch.device("cuda", 0)) == "NVIDIA H200"
    assert gpu.device_title(torch.device("cpu")) == "cpu"


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."), True),
        (RuntimeError("CUDA error: out of memory"), True),
        (RuntimeError("Triton Error [CUDA]: out of memory"), True),
        (RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling cublasCreate"), True),
        (RuntimeError("CUDA error: an illegal memory access was encountered"), False),
        (ValueError("out of memory"), False),
    ],
)
def test_who_allocates_beside_torch_says_so_in_the_message(error, expected):
    assert lacks_memory(error) == expected


def test_the_kernels_take_cpu_tensors_only_where_they_are_interpreted(monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    single, double = torch.zeros(2), torch.zeros(2, dtype=torch.float64)
    assert not gpu.runs_triton(single)
    with gpu.interpreted():
        assert gpu.runs_triton(single)
        assert not gpu.runs_triton(double)
        assert not gpu.runs_triton(single.to("meta"))
    assert not gpu.runs_triton(single)


def test_triton_is_not_loaded_by_the_cpu_path():
    """Only the packages of kernels import it, and only dispatchers import those."""
    source = Path(gpu.__file__).parent
    importers = [
        path for path in source.rglob("*.py") if "import triton" in path.read_text(encoding="utf-8")
    ]
    assert {path.relative_to(source).parts[1] for path in importers} <= {"gpu"}


@pytest.mark.parametrize("name", ["gpu", "cuda:0", "CPU", torch.device("cpu"), None])
def test_other_names_of_devices_are_refused(name):
    with pytest.raises(DeviceError, match=r"unknown device .*: choose one of auto, cpu, cuda"):
        gpu.choose_device(name)
