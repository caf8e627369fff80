"""Compiled kernels on disk: none is stale, and none is compiled twice at the same time."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mrgs.kernels import cache

MODULES = {
    "constants": "SCALE = 2.0\n",
    "base": """
from mrgs.kernels.constants import SCALE
from mrgs.kernels.jit import kernel
from mrgs.rasterizer import contract


@kernel
def scaled(x):
    return SCALE * x + contract.OFFSET
""",
    "above": """
from mrgs.kernels.base import scaled
from mrgs.kernels.jit import kernel


@kernel
def twice(x):
    return 2.0 * scaled(x)
""",
    "other": """
from mrgs.kernels.jit import kernel


@kernel()
def squared(x):
    return x * x
""",
}
"""Kernels of a package made for these tests: ``above`` calls ``base``, ``other`` stands alone."""

CALL = """
import sys
sys.path[:0] = {path!r}
from mrgs.kernels.above import twice
from mrgs.kernels.base import scaled
from mrgs.kernels.other import squared
{before}
values = twice(3.0), squared(3.0)
compiled = [f.py_func.__name__ for f in (scaled, twice, squared) if f.stats.cache_misses]
print(*values, *compiled)
"""

HOLD = """
import os
from mrgs.kernels import cache
cache.KernelCache.save_overload = lambda *args: (print("compiled", flush=True), os.read(0, 1))
"""
"""Stops a process, with the lock held, when it has compiled a kernel and before it saves it."""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package like this one: the real cache, and small kernels."""
    root = tmp_path / "mrgs"
    for folder in (root, root / "kernels", root / "rasterizer"):
        folder.mkdir()
        (folder / "__init__.py").touch()
    for name in ("jit.py", "cache.py"):
        shutil.copy(cache.FOLDER / name, root / "kernels")
    (root / "rasterizer" / "contract.py").write_text("OFFSET = 1.0\n")
    for name, text in MODULES.items():
        (root / "kernels" / f"{name}.py").write_text(text)
    return root


def start(package: Path, before: str = "") -> subprocess.Popen[str]:
    path = [str(package.parent), *filter(None, sys.path)]
    return subprocess.Popen(
        [sys.executable, "-c", CALL.format(path=path, before=before)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def printed(process: subprocess.Popen[str]) -> list[str]:
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out.split()


def edit(path: Path, before: str, after: str) -> None:
    """Another length, for Python's own cache goes by length and second."""
    assert before in path.read_text()
    assert len(before) != len(after)
    path.write_text(path.read_text().replace(before, after))


def test_what_was_edited_and_what_depends_on_it_is_compiled_again(package):
    assert printed(start(package)) == ["14.0", "9.0", "scaled", "twice", "squared"]
    assert printed(start(package)) == ["14.0", "9.0"]
    edit(package / "kernels/above.py", "2.0 *", "10.0 *")
    assert printed(start(package)) == ["70.0", "9.0", "twice"]
    edit(package / "kernels/constants.py", "2.0", "20.0")
    assert printed(start(package)) == ["610.0", "9.0", "scaled", "twice"]
    edit(package / "rasterizer/contract.py", "1.0", "10.0")
    edit(package / "kernels/constants.py", "20.0", "2.0")
    assert printed(start(package)) == ["160.0", "9.0", "scaled", "twice"]
    compiled = {path.name.split("-")[0] for path in package.rglob("*.nbi")}
    assert len(list(package.rglob("*.nbi"))) == len(compiled) == 3


def test_two_processes_compile_each_kernel_once(package):
    processes = [start(package) for _ in range(2)]
    first, second = map(printed, processes)
    assert first[:2] == second[:2] == ["14.0", "9.0"]
    assert sorted(first[2:] + second[2:]) == ["scaled", "squared", "twice"]


def holding_a_lock(package: Path) -> subprocess.Popen[str]:
    holder = start(package, HOLD)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "compiled\n"
    return holder


def test_the_lock_of_a_killed_process_ends_with_it(package):
    holder = holding_a_lock(package)
    waiting = start(package)
    holder.kill()
    holder.communicate()
    assert printed(waiting)[2:] == ["scaled", "twice", "squared"]


@pytest.mark.parametrize("locks", ["_patience = 0.1", "_lock = property(lambda self: open('/'))"])
def test_without_the_lock_a_kernel_is_compiled_after_a_while(package, locks):
    holder = holding_a_lock(package)
    try:
        waiting = start(package, f"from mrgs.kernels import cache; cache.KernelCache.{locks}")
        assert printed(waiting)[2:] == ["scaled", "twice", "squared"]
    finally:
        holder.communicate("x")


def test_a_stamp_covers_what_is_imported_and_nothing_else():
    def sources(name: str) -> set[str]:
        found = cache._sources(cache.FOLDER / name)
        return {path.relative_to(cache.FOLDER.parent).as_posix() for path in found}

    jit = "kernels/jit.py"
    assert sources("dense/product.py") == {"kernels/dense/product.py", jit}
    assert sources("blur/separable.py") == {"kernels/blur/separable.py", "kernels/address.py", jit}
    rasterizer = sources("rasterize/cpu/blend_backward.py")
    assert "rasterizer/splat.py" in rasterizer
    assert "kernels/rasterize/cpu/simd.py" in rasterizer
    assert "kernels/rasterize/cpu/projection.py" not in rasterizer
