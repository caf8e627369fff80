from __future__ import annotations

import dataclasses
import os
import re
import sysconfig
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from mrgs.errors import DeviceError, MrgsWarning
from mrgs.system import gpu
from mrgs.system.gpu import Machine, lacks_memory

choose_device = gpu.choose_device  # before the tests' own, which takes the CPU for "auto"


@dataclasses.dataclass
class Cuda:
    """What torch.cuda says where there is a GPU; or why it does not start."""

    capability: tuple[int, int] = (9, 0)
    name: str = "NVIDIA H200"
    failure: str = ""
    starts: bool = True

    def is_available(self) -> bool:
        return not self.failure

    def init(self) -> None:
        raise RuntimeError(self.failure)

    def current_device(self) -> int:
        return 0

    def get_device_name(self) -> str:
        return self.name

    def get_device_capability(self) -> tuple[int, int]:
        if not self.starts:
            raise RuntimeError("CUDA error: initialization error\nIt might be reported later\n")
        return self.capability


class FakeMachine(SimpleNamespace):
    def _replace(self, **changes):
        return FakeMachine(**{**vars(self), **changes})


@pytest.fixture
def machine(tmp_path: Path) -> FakeMachine:
    """A machine with a GPU on which everything is right."""
    (tmp_path / "Python.h").touch()
    cuda = Cuda()
    return FakeMachine(
        has_driver=True, has_triton=True, triton_version="3.4.0", has_compiler=True,
        headers=[tmp_path], platform="linux", torch_version="2.13.0", built_for="12.8", cuda=cuda,
    )  # fmt: skip


NO_DRIVER = "Found no NVIDIA driver on your system. Please check that you have an NVIDIA GPU"
OLD_DRIVER = "The NVIDIA driver on your system is too old (found version 11040)"
WITHOUT_CUDA = {"built_for": None, "torch_version": "2.13.0+cpu"}
WITHOUT_DRIVER = {"cuda": Cuda(failure=NO_DRIVER), "has_driver": False}

OBSTACLES = {
    "no driver": (WITHOUT_DRIVER, "nvidia.com/drivers"),
    "an old driver": ({"cuda": Cuda(failure=OLD_DRIVER)}, "CUDA 12.8"),
    "a hidden GPU": ({"cuda": Cuda(failure="No CUDA GPUs are available")}, "CUDA_VISIBLE_DEVICES"),
    "torch for the CPU": (WITHOUT_CUDA, "2.13.0+cpu"),
    "an old GPU": ({"cuda": Cuda((6, 1), "GTX 1080")}, "GTX 1080"),
    "no Triton": ({"has_triton": False}, "install triton"),
    "an old Triton": ({"triton_version": "3.3.1+gitc8757738"}, "3.3.1"),
    "no compiler": ({"has_compiler": False}, "gcc"),
    "no headers": ({"headers": [Path("/nowhere")]}, str(Path("/nowhere/Python.h"))),
    "a GPU that does not start": ({"cuda": Cuda(starts=False)}, "initialization error"),
}
"""By what is wrong: how that machine differs, and the keyword of what would mend it."""

obstacles = pytest.mark.parametrize("obstacle", OBSTACLES)


@obstacles
def test_a_gpu_that_cannot_be_used_is_refused_with_what_would_mend_it(obstacle, machine):
    changes, keyword = OBSTACLES[obstacle]
    with pytest.raises(DeviceError, match=re.escape(keyword)) as caught:
        choose_device("cuda", machine._replace(**changes))
    message = str(caught.value)
    assert "CPU" in message


@obstacles
def test_auto_says_once_why_a_gpu_that_is_there_is_not_used(obstacle, machine):
    changes, keyword = OBSTACLES[obstacle]
    there = machine._replace(**changes | {"has_driver": True})
    with pytest.warns(MrgsWarning, match=re.escape(keyword)) as caught:
        assert choose_device("auto", there) == torch.device("cpu")
    assert len(caught) == 1


@pytest.mark.parametrize("changes", [WITHOUT_DRIVER, WITHOUT_CUDA | {"has_driver": False}])
def test_auto_is_quiet_where_there_is_no_gpu(changes, machine):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert choose_device("auto", machine._replace(**changes)) == torch.device("cpu")


@pytest.mark.skipif(os.name != "posix", reason="the schemes of POSIX")
def test_headers_are_looked_for_where_triton_does_on_debian(monkeypatch):
    found = []
    for scheme in ("posix_local", "posix_prefix"):
        monkeypatch.setattr(sysconfig, "get_default_scheme", lambda chosen=scheme: chosen)
        found.append(Machine().headers)
    assert found[0] == found[1]


@pytest.mark.parametrize("name", ["CPATH", "C_INCLUDE_PATH"])
def test_headers_may_be_where_the_compiler_is_told(name, machine, monkeypatch):
    (there,) = machine.headers
    monkeypatch.setenv(name, f"/elsewhere{os.pathsep}{there}")
    _, *told = Machine().headers
    assert told[-2:] == [Path("/elsewhere"), there]
    assert choose_device("cuda", machine._replace(headers=[Path("/nowhere"), *told])).type == "cuda"


def test_a_compiler_is_found_by_its_name_or_by_the_variable(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert not Machine().has_compiler
    monkeypatch.setenv("CC", "mine")
    assert Machine().has_compiler


def test_there_is_no_cuda_on_a_mac(machine):
    with pytest.raises(DeviceError, match="macOS"):
        choose_device("cuda", machine._replace(platform="darwin"))


@pytest.mark.parametrize("version", ["3.4.0", "3.10.0", "4.0", None])
def test_newer_versions_of_triton_and_unknown_ones_are_tried(version, machine):
    assert choose_device("cuda", machine._replace(triton_version=version)).type == "cuda"


def test_a_gpu_that_can_be_used_is_used_unless_the_cpu_is_asked_for(machine):
    chosen = [choose_device(name, machine) for name in ("auto", "cuda", "cpu")]
    assert chosen == [torch.device("cuda", 0), torch.device("cuda", 0), torch.device("cpu")]
    assert gpu.device_title(torch.device("cpu")) == "cpu"


@pytest.mark.filterwarnings("ignore::mrgs.errors.MrgsWarning")
def test_this_machine_can_be_asked():
    assert choose_device("auto").type in ("cpu", "cuda")


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (torch.cuda.OutOfMemoryError("2.00 GiB"), True),
        (RuntimeError("Triton Error [CUDA]: out of memory"), True),
        (RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED"), True),
        (RuntimeError("CUDA error: illegal memory access"), False),
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
    with pytest.raises(DeviceError, match="auto, cpu, cuda"):
        gpu.choose_device(name)
