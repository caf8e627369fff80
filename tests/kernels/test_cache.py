"""Compiled kernels on disk: none is stale, and no cache is trusted that others can write to."""

from __future__ import annotations

import ast
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from numba.extending import is_jitted

from mrgs.errors import MrgsWarning
from mrgs.kernels import cache
from mrgs.rasterizer import contract

KERNEL = """
from mrgs.kernels.jit import strict_kernel
SCALE = 2.0
@strict_kernel
def scaled(x):
    return SCALE * x
"""

Load = Callable[[], Any]

_numbers = count()


def clear() -> None:
    cache.version_folder.cache_clear()
    cache._warn_not_kept.cache_clear()


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The root of the caches of a test."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # it goes by seconds and lengths
    clear()
    yield tmp_path / "cache" / "mrgs"
    clear()


@pytest.fixture
def kernel(tmp_path: Path) -> Path:
    """The file of a kernel."""
    file = tmp_path / "kernels.py"
    file.write_text(KERNEL)
    return file


def start(file: Path) -> Any:
    """The kernel, as a new process would find it."""
    clear()
    spec = importlib.util.spec_from_file_location(f"kernels_{next(_numbers)}", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not is_jitted(module.scaled):
        pytest.skip("nothing is compiled")
    return module.scaled


def result(file: Path) -> tuple[float, str]:
    """What the kernel makes of 3, and whether it was compiled or loaded."""
    scaled = start(file)
    value = scaled(3.0)
    return value, "loaded" if scaled.stats.cache_hits else "compiled"


def test_a_kernel_is_compiled_once_and_again_when_it_was_edited(kernel):
    assert result(kernel) == (6.0, "compiled")
    assert result(kernel) == (6.0, "loaded")
    kernel.write_text(KERNEL.replace("2.0", "5.0"))
    assert result(kernel) == (15.0, "compiled")
    kernel.write_text(KERNEL)
    assert result(kernel) == (6.0, "loaded")


def test_what_was_edited_under_a_running_process_is_not_kept(kernel, place):
    scaled = start(kernel)
    kernel.write_text(KERNEL.replace("2.0", "5.0"))
    assert scaled(3.0) == 6.0
    assert list(place.rglob("*.nbc")) == []
    assert result(kernel) == (15.0, "compiled")


def test_another_checkout_of_the_same_sources_loads_what_is_compiled(kernel, tmp_path):
    assert result(kernel) == (6.0, "compiled")
    copy = tmp_path / "elsewhere" / tmp_path.name / kernel.name
    copy.parent.mkdir(parents=True)
    copy.write_text(KERNEL)
    os.utime(copy, (0, 0))
    assert result(copy) == (6.0, "loaded")


def test_any_source_and_any_constant_is_in_the_digest(kernel, tmp_path, monkeypatch):
    package = tmp_path / "package" / "kernels"
    package.mkdir(parents=True)
    files = [package / "__init__.py", package / "a.py", package.parent / "definitions.py"]
    for file in files:
        file.write_text("X = 1\n")
    digests = [cache.digest_of(package)]
    for file in files:
        file.write_text("X = 2\n")
        digests.append(cache.digest_of(package))
    monkeypatch.setattr(contract, "ALPHA_MIN", 0.5)
    digests.append(cache.digest_of(package))
    monkeypatch.setattr(cache, "FOLDER", package)
    digests.append(cache.digest_of(package))
    assert len(set(digests)) == len(digests)
    assert cache.digest_of(package) == digests[-1]


def test_kernels_take_constants_from_those_modules_that_the_digest_covers():
    covered = {module.__name__ for module in cache.CONSTANTS}
    strangers = set()
    for file in cache.FOLDER.rglob("*.py"):
        imports = [
            n for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.ImportFrom)
        ]
        if not any(each.module == "mrgs.kernels.jit" for each in imports):
            continue
        for each in imports:
            if each.module.startswith("mrgs.") and not each.module.startswith("mrgs.kernels"):
                home = importlib.import_module(each.module)
                for alias in each.names:
                    value = getattr(home, alias.name)
                    if isinstance(value, ModuleType):
                        strangers |= {value.__name__} - covered
                    elif isinstance(value, (int, float, tuple)) and each.module not in covered:
                        strangers.add(f"{each.module}.{alias.name}")
    assert strangers == set()


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", [lambda data: data[:100], lambda data: b""])
def test_a_damaged_kernel_is_compiled_again(kernel, place, suffix, damage):
    result(kernel)
    (file,) = place.rglob(f"*{suffix}")
    file.write_bytes(damage(file.read_bytes()))
    assert result(kernel) == (6.0, "compiled")
    assert result(kernel) == (6.0, "loaded")


@pytest.mark.skipif(os.name == "nt", reason="no such permissions")
def test_a_cache_that_others_can_write_to_is_not_used(kernel, place):
    place.mkdir(parents=True)
    place.chmod(0o777)
    with pytest.warns(MrgsWarning, match="other users"):
        assert result(kernel) == (6.0, "compiled")
    assert list(place.iterdir()) == []


def test_without_any_place_kernels_run(kernel, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/proc/none")
    with pytest.warns(MrgsWarning, match="NUMBA_CACHE_DIR") as caught:
        assert result(kernel) == (6.0, "compiled")
    assert len(caught) == 1


def test_a_full_disk_costs_only_the_time_to_compile(kernel, monkeypatch):
    def fail(*arguments: Any) -> None:
        raise OSError(28, "No space left on device")

    scaled = start(kernel)
    monkeypatch.setattr(scaled._cache._cache_file, "_save_index", fail)
    with pytest.warns(MrgsWarning, match="No space left"):
        assert scaled(3.0) == 6.0


def test_processes_that_compile_at_the_same_time_share_no_file(kernel, place, monkeypatch):
    for process, x in (("a", 3.0), ("b", 3)):
        monkeypatch.setattr(cache, "_PROCESS", process)
        scaled = start(kernel)
        scaled._cache._cache_file._load_index = dict  # what the other has saved is not there yet
        assert scaled(x) == 6.0
    assert len({file.name for file in place.rglob("*.nbc")}) == 2
    scaled = start(kernel)
    assert (scaled(3.0), scaled(3)) == (6.0, 6.0)


@pytest.mark.slow
def test_two_processes_that_compile_different_signatures_do_not_mix_them_up(kernel, place):
    script = f"import runpy; f = runpy.run_path({str(kernel)!r})['scaled']; print(f({{}}))"
    processes = [
        subprocess.Popen([sys.executable, "-c", script.format(x)], stdout=subprocess.PIPE)
        for x in ("3.0", "3")
    ]
    assert [float(process.communicate()[0]) for process in processes] == [6.0, 6.0]
    assert len({file.name for file in place.rglob("*.nbc")}) == 2
    scaled = start(kernel)
    assert (scaled(3.0), scaled(3)) == (6.0, 6.0)


def test_versions_that_were_not_used_for_long_are_deleted(kernel, place):
    for number in range(cache.VERSIONS_KEPT):
        old = place / f"old{number}"
        old.mkdir(parents=True)
        os.utime(old, (number, number))
    place.chmod(0o700)
    result(kernel)
    kept = sorted(path.name for path in place.iterdir())
    assert len(kept) == cache.VERSIONS_KEPT
    assert "old0" not in kept
    assert "old1" in kept
