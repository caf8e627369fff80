"""Compiled kernels on disk: none is stale, and none is compiled twice at the same time."""

from __future__ import annotations

import os
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
from mrgs.kernels.jit import strict_kernel
from mrgs.rasterizer import contract


@strict_kernel
def scaled(x):
    return SCALE * x + contract.OFFSET
""",
    "above": """
from mrgs.kernels.base import scaled
from mrgs.kernels.jit import strict_kernel


@strict_kernel
def twice(x):
    return 2.0 * scaled(x)
""",
    "other": """
from mrgs.kernels.jit import strict_kernel


from mrgs.rasterizer.sizes import HALF as H


@strict_kernel()
def squared(x):
    return x * x * H / LATER


LATER = 0.5
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
    for folder in (root, root / "kernels", root / "rasterizer", root / "system"):
        folder.mkdir()
        (folder / "__init__.py").touch()
    for name in ("kernels/jit.py", "kernels/cache.py", "system/private.py", "errors.py"):
        shutil.copy(cache.FOLDER.parent / name, root / name)
    (root / "rasterizer" / "contract.py").write_text("OFFSET = 1.0\n")
    (root / "rasterizer" / "sizes.py").write_text("import os\nHALF = float(os.environ['HALF'])\n")
    for name, text in MODULES.items():
        (root / "kernels" / f"{name}.py").write_text(text)
    return root


def start(package: Path, before: str = "", **variables: str) -> subprocess.Popen[str]:
    path = [str(package.parent), *filter(None, sys.path)]
    return subprocess.Popen(
        [sys.executable, "-c", CALL.format(path=path, before=before)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "HALF": "0.5", "PYTHONDONTWRITEBYTECODE": "1", **variables},
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_the_lock_of_a_killed_process_ends_with_it(package):
    holder = holding_a_lock(package)
    waiting = start(package)
    holder.kill()
    holder.communicate()
    assert printed(waiting)[2:] == ["scaled", "twice", "squared"]


@pytest.mark.slow
@pytest.mark.parametrize("locks", ["_patience = 0.1", "_lock = property(lambda self: open('/'))"])
def test_without_the_lock_a_kernel_is_compiled_after_a_while(package, locks):
    holder = holding_a_lock(package)
    try:
        waiting = start(package, f"from mrgs.kernels import cache; cache.KernelCache.{locks}")
        assert printed(waiting)[2:] == ["scaled", "twice", "squared"]
    finally:
        holder.communicate("x")


@pytest.mark.slow
def test_a_constant_is_known_by_its_value_wherever_it_comes_from(package):
    assert printed(start(package))[:2] == ["14.0", "9.0"]
    assert printed(start(package, HALF="5.0")) == ["14.0", "90.0", "squared"]
    edit(package / "kernels/other.py", "LATER = 0.5", "LATER = 0.25")
    assert printed(start(package)) == ["14.0", "18.0", "squared"]
    (package / "rasterizer/more.py").write_text("OFFSET = 10.0\n")
    (package / "rasterizer/contract.py").write_text("from mrgs.rasterizer.more import OFFSET\n")
    assert printed(start(package)) == ["32.0", "18.0", "scaled", "twice"]


@pytest.mark.parametrize("suffix", [pytest.param(".nbi", marks=pytest.mark.slow), ".nbc"])
def test_a_damaged_kernel_is_compiled_again(package, suffix):
    printed(start(package))
    cut, flipped, empty = package.rglob(f"*{suffix}")
    cut.write_bytes(cut.read_bytes()[:100])
    data = bytearray(flipped.read_bytes())
    data[len(data) // 2] ^= 4
    flipped.write_bytes(data)
    empty.write_bytes(b"")
    assert printed(start(package))[:2] == ["14.0", "9.0"]
    assert printed(start(package)) == ["14.0", "9.0"]


@pytest.mark.slow
def test_a_folder_that_others_can_write_to_is_not_used(package, tmp_path):
    open_to_all = tmp_path / "cache"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    kernels = package / "kernels/__pycache__"
    kernels.mkdir()
    kernels.chmod(0o777)
    home = tmp_path / "home"
    places = {"NUMBA_CACHE_DIR": str(open_to_all), "HOME": str(home), "XDG_CACHE_HOME": str(home)}
    assert printed(start(package, **places))[:2] == ["14.0", "9.0"]
    assert list(open_to_all.iterdir()) == []
    assert not list(kernels.glob("*.nb?"))
    assert len(list(home.rglob("*.nbi"))) == 3
    assert printed(start(package, **places)) == ["14.0", "9.0"]


def test_without_any_folder_kernels_run_and_one_line_says_why(package):
    nowhere = {"NUMBA_CACHE_DIR": "/proc/none", "HOME": "/proc/none", "XDG_CACHE_HOME": "/proc/no"}
    (package / "kernels/__pycache__").touch()  # a file, where the folder would be
    process = start(package, **nowhere)
    out, err = process.communicate(timeout=120)
    assert out.split() == ["14.0", "9.0", "scaled", "twice", "squared"]
    assert err.count("compiled kernels are not kept") == 1


def test_a_full_disk_costs_only_the_time_to_compile(package):
    full = """
from mrgs.kernels import cache
def fail(*args):
    raise OSError(28, "No space left on device")
cache._Files._save_index = fail
"""
    process = start(package, full)
    out, err = process.communicate(timeout=120)
    assert out.split() == ["14.0", "9.0", "scaled", "twice", "squared"]
    assert "No space left" in err


def test_a_stamp_covers_the_code_that_is_imported_and_nothing_else():
    def sources(name: str) -> set[str]:
        found = cache._sources(cache.FOLDER / name)
        return {path.relative_to(cache.FOLDER.parent).as_posix() for path in found}

    jit = "kernels/jit.py"
    assert sources("dense/product.py") == {"kernels/dense/product.py", jit}
    assert sources("blur/separable.py") == {"kernels/blur/separable.py", "kernels/address.py", jit}
    rasterizer = sources("rasterize/cpu/blend_backward.py")
    assert "kernels/rasterize/cpu/simd.py" in rasterizer
    assert "kernels/rasterize/cpu/projection.py" not in rasterizer
