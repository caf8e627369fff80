"""Which device to train and render on, and whether Triton kernels run there; every question about
it is here."""

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
from functools import lru_cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Literal, TypeAlias, get_args

import torch
from torch import Tensor

from mrgs.errors import DeviceError
from mrgs.system.callers import warn

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
    """Whether Triton kernels take this tensor: float32, and on an NVIDIA GPU (or within
    ``interpreted``)."""
    if tensor.dtype != torch.float32:
        return False
    if tensor.is_cuda:
        return _has_triton()
    return tensor.is_cpu and _interpreted.get()


@contextmanager
def interpreted() -> Iterator[None]:
    """Within this block the kernels take CPU tensors, through Triton's interpreter: slow, for
    tests.

    The environment variable TRITON_INTERPRET=1 must have been set before Triton was first imported.
    """
    assert os.environ.get("TRITON_INTERPRET") == "1", (
        "set TRITON_INTERPRET=1 before Triton is imported"
    )
    token = _interpreted.set(True)
    try:
        yield
    finally:
        _interpreted.reset(token)


def choose_device(name: DeviceName) -> torch.device:
    """The device of a name; "auto" is the GPU where there is one that can be used, else the CPU.

    Warns:
        MrgsWarning: "auto", and there is an NVIDIA GPU that cannot be used; the message says why.

    Raises:
        DeviceError: another name; or "cuda", and the GPU cannot be used; the message says what to
            do.
    """
    if name not in get_args(DeviceName):
        raise DeviceError(
            f"unknown device {name!r}: choose one of {', '.join(get_args(DeviceName))}; of several "
            f"GPUs CUDA_VISIBLE_DEVICES chooses one",
            options=("device",),
        )
    if name == "cpu":
        return torch.device("cpu")
    obstacle = _obstacle()
    if obstacle is None:
        return torch.device("cuda", torch.cuda.current_device())
    if name == "cuda":
        raise DeviceError(f"{obstacle}; or use the CPU", options=("device",))
    if _driver_is_installed():
        warn(f"the NVIDIA GPU is not used: {obstacle}")
    return torch.device("cpu")


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


def _obstacle() -> str | None:
    """Why the GPU cannot be used, and the remedy; None if it can."""
    if sys.platform == "darwin":
        return "there is no CUDA for macOS"
    if torch.version.cuda is None:
        index = (
            " --index-url https://download.pytorch.org/whl/cu128" if sys.platform == "win32" else ""
        )
        return (
            f"this torch ({torch.__version__}) is built without CUDA: pip install "
            f"--force-reinstall torch{index}"
        )
    return _driver_obstacle() or _capability_obstacle() or _triton_obstacle()


def _driver_obstacle() -> str | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's own warning about an old driver; ours is below
        if torch.cuda.is_available():
            return None
        try:
            torch.cuda.init()
        except (RuntimeError, AssertionError) as error:
            reason = str(error)
        else:
            reason = ""
    if "too old" in reason:
        return (
            f"the NVIDIA driver is too old for this torch, which was built for CUDA "
            f"{torch.version.cuda}: "
            "install a newer driver, or a torch for an older CUDA"
        )
    if "no NVIDIA driver" in reason or not _driver_is_installed():
        return "no NVIDIA driver was found: install it from https://www.nvidia.com/drivers"
    return "no usable NVIDIA GPU was found: check `nvidia-smi` and CUDA_VISIBLE_DEVICES"


def _capability_obstacle() -> str | None:
    try:
        found = (
            torch.cuda.get_device_capability()
        )  # starts CUDA; that a GPU is visible does not say that it starts
    except (RuntimeError, AssertionError, torch.cuda.DeferredCudaCallError) as error:
        reason = str(error).partition("\n")[0]
        return f"the GPU cannot be started: {reason}"
    if found >= OLDEST_CAPABILITY:
        return None
    oldest = ".".join(map(str, OLDEST_CAPABILITY))
    return (
        f"the {torch.cuda.get_device_name()} is too old: "
        f"it has compute capability {found[0]}.{found[1]}, and {oldest} or newer is needed"
    )


def _triton_obstacle() -> str | None:
    if not _has_triton():
        if sys.platform == "win32":
            return "Triton is missing: pip install triton-windows"
        return "Triton is missing: pip install triton"
    version = _triton_version()
    if version is not None and _numbers(version) < OLDEST_TRITON:
        return (
            f"Triton {version} is too old: {'.'.join(map(str, OLDEST_TRITON))} or newer is needed, "
            "which comes with torch 2.8: pip install --upgrade torch"
        )
    if not (
        os.environ.get("CC")
        or shutil.which("gcc")
        or shutil.which("clang")
        or sys.platform == "win32"
    ):
        return (
            "Triton needs a C compiler, once, to start its kernels: install gcc or clang, or "
            "name one in CC"
        )
    if not (
        sys.platform == "win32"
        or any((folder / "Python.h").exists() for folder in _header_folders())
    ):
        return (
            "Triton needs Python's C headers, once, to start its kernels, but there is no "
            f"{_header_folders()[0] / 'Python.h'}: install python3-dev (python3-devel on Fedora)"
        )
    return None


def _header_folders() -> list[Path]:
    """Where Python.h is looked for when Triton compiles: its own choice first, then the options of
    a C compiler."""
    scheme = sysconfig.get_default_scheme()
    if (
        scheme == "posix_local"
    ):  # Debian's, which names a folder below /usr/local that holds no headers
        scheme = "posix_prefix"
    searched = [os.environ.get(name, "").split(os.pathsep) for name in ("CPATH", "C_INCLUDE_PATH")]
    return [
        Path(sysconfig.get_paths(scheme)["include"]),
        *(Path(folder) for each in searched for folder in each if folder),
    ]


@lru_cache(maxsize=1)
def _has_triton() -> bool:
    return importlib.util.find_spec("triton") is not None


def _triton_version() -> str | None:
    """Read without loading Triton, which decides when it is imported whether it interprets."""
    for name in ("triton", "triton-windows"):
        with suppress(PackageNotFoundError):
            return installed_version(name)
    return None


def _numbers(version: str) -> tuple[int, ...]:
    """(3, 4) of "3.4.0+git1"."""
    return tuple(int(number) for number in re.findall(r"\d+", version)[:2])


def _driver_is_installed() -> bool:
    return Path("/proc/driver/nvidia/version").exists() or shutil.which("nvidia-smi") is not None
