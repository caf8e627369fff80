"""Every question about the device to train and render on, and whether Triton kernels run there."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import sys
import sysconfig
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import torch
from torch import Tensor

from mrgs.errors import DeviceError, warn_user

HOST = torch.device("cpu")

DeviceName: TypeAlias = Literal["auto", "cpu", "cuda"]

OLDEST_CAPABILITY = (7, 5)
"""Turing (2018): the oldest GPUs for which both torch and Triton still build code."""

OLDEST_TRITON = (3, 4)
"""Older ones cannot compile the kernels: 3.3, which comes with torch 2.7, fails on 4 of them."""

# Multiplications and additions are fused, as in the CPU kernels. Triton 3.9 warns unless this is
# said.
os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")

_interpreted: ContextVar[bool] = ContextVar("mrgs_gpu_interpreted", default=False)


def runs_triton(tensor: Tensor) -> bool:
    """Whether Triton takes this tensor: float32 on an NVIDIA GPU, or within ``interpreted``."""
    if tensor.dtype != torch.float32:
        return False
    if tensor.is_cuda:
        return _has_triton()
    return tensor.is_cpu and _interpreted.get()


@contextmanager
def interpreted() -> Iterator[None]:
    """Within this block the kernels take CPU tensors, through Triton's slow interpreter, for tests.
    TRITON_INTERPRET=1 must have been set before Triton was first imported."""
    assert os.environ.get("TRITON_INTERPRET") == "1", (
        "set TRITON_INTERPRET=1 before Triton is imported"
    )
    token = _interpreted.set(True)
    try:
        yield
    finally:
        _interpreted.reset(token)


class Machine:
    """What a choice of the device depends on, looked up when it is asked for."""

    platform = sys.platform
    torch_version = torch.__version__
    built_for = torch.version.cuda
    cuda: Any = torch.cuda

    @property
    def has_driver(self) -> bool:
        """Whether NVIDIA's driver is installed."""
        driver = Path("/proc/driver/nvidia/version")
        return driver.exists() or shutil.which("nvidia-smi") is not None

    @property
    def has_triton(self) -> bool:
        """Whether Triton is installed."""
        return _has_triton()

    @property
    def triton_version(self) -> str | None:
        """Read without loading Triton, which decides when it is imported whether it interprets."""
        with suppress(PackageNotFoundError):
            return installed_version("triton")
        return None

    @property
    def has_compiler(self) -> bool:
        """Whether Triton finds a C compiler."""
        return bool(os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang"))

    @property
    def headers(self) -> list[Path]:
        """Where Triton finds Python.h: its own choice first, then the compiler's options."""
        scheme = sysconfig.get_default_scheme()
        if scheme == "posix_local":  # Debian's names a folder below /usr/local without headers
            scheme = "posix_prefix"
        options = (os.environ.get(name, "") for name in ("CPATH", "C_INCLUDE_PATH"))
        folders = [folder for each in options for folder in each.split(os.pathsep) if folder]
        return [Path(folder) for folder in (sysconfig.get_paths(scheme)["include"], *folders)]


def choose_device(name: DeviceName, machine: Any = Machine()) -> torch.device:  # noqa: B008
    """The device of a name; "auto" is the GPU where there is one that can be used, else the CPU.
    DeviceError for another name, or if "cuda" cannot be used; the message says what to do.
    MrgsWarning if "auto" finds an NVIDIA GPU that cannot be used; the message says why."""
    if name not in get_args(DeviceName):
        raise DeviceError(
            f"unknown device {name!r}: choose one of {', '.join(get_args(DeviceName))}; of several "
            f"GPUs CUDA_VISIBLE_DEVICES chooses one",
            options=("device",),
        )
    if name == "cpu":
        return HOST
    obstacle = _obstacle(machine)
    if obstacle is None:
        return torch.device("cuda", machine.cuda.current_device())
    if name == "cuda":
        raise DeviceError(f"{obstacle}; or use the CPU", options=("device",))
    if machine.has_driver:
        warn_user(f"the NVIDIA GPU is not used: {obstacle}")
    return HOST


def device_title(device: torch.device) -> str:
    """What a report calls a device: the GPU's name, or "cpu"."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def lacks_memory(error: Exception) -> bool:
    """Whether a GPU's memory did not suffice. Torch's allocator has an error of its own for it;
    CUDA, cuBLAS and Triton, which allocate beside it, say so in the message."""
    if isinstance(error, torch.cuda.OutOfMemoryError):
        return True
    message = str(error)
    return isinstance(error, RuntimeError) and (
        "out of memory" in message or "ALLOC_FAILED" in message
    )


def _obstacle(machine: Any) -> str | None:
    """Why the GPU cannot be used, and the remedy; None if it can."""
    if machine.platform == "darwin":
        return "there is no CUDA for macOS"
    if machine.built_for is None:
        return (
            f"this torch ({machine.torch_version}) is built without CUDA: pip install "
            "--force-reinstall torch"
        )
    return (
        _driver_obstacle(machine) or _capability_obstacle(machine.cuda) or _triton_obstacle(machine)
    )


def _driver_obstacle(machine: Any) -> str | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's own warning about an old driver; ours is below
        if machine.cuda.is_available():
            return None
        try:
            machine.cuda.init()
        except (RuntimeError, AssertionError) as error:
            reason = str(error)
        else:
            reason = ""
    if "too old" in reason:
        return (
            f"the NVIDIA driver is too old for this torch, which was built for CUDA "
            f"{machine.built_for}: install a newer driver, or a torch for an older CUDA"
        )
    if "no NVIDIA driver" in reason or not machine.has_driver:
        return "no NVIDIA driver was found: install it from https://www.nvidia.com/drivers"
    return "no usable NVIDIA GPU was found: check `nvidia-smi` and CUDA_VISIBLE_DEVICES"


def _capability_obstacle(cuda: Any) -> str | None:
    try:
        # Starts CUDA; that a GPU is visible does not say that it starts.
        found = cuda.get_device_capability()
    except (RuntimeError, AssertionError, torch.cuda.DeferredCudaCallError) as error:
        reason = str(error).partition("\n")[0]
        return f"the GPU cannot be started: {reason}"
    if found >= OLDEST_CAPABILITY:
        return None
    oldest = ".".join(map(str, OLDEST_CAPABILITY))
    return (
        f"the {cuda.get_device_name()} is too old: "
        f"it has compute capability {found[0]}.{found[1]}, and {oldest} or newer is needed"
    )


def _triton_obstacle(machine: Any) -> str | None:
    if not machine.has_triton:
        return "Triton is missing: pip install triton"
    version = machine.triton_version
    numbers = tuple(map(int, re.findall(r"\d+", version or "")[:2]))
    if version is not None and numbers < OLDEST_TRITON:
        return (
            f"Triton {version} is too old: {'.'.join(map(str, OLDEST_TRITON))} or newer is needed, "
            "which comes with torch 2.8: pip install --upgrade torch"
        )
    if not machine.has_compiler:
        return (
            "Triton needs a C compiler, once, to start its kernels: install gcc or clang, or "
            "name one in CC"
        )
    if not any((folder / "Python.h").exists() for folder in machine.headers):
        return (
            "Triton needs Python's C headers, once, to start its kernels, but there is no "
            f"{machine.headers[0] / 'Python.h'}: install python3-dev (python3-devel on Fedora)"
        )
    return None


@cache
def _has_triton() -> bool:
    return importlib.util.find_spec("triton") is not None
