"""Compiled Numba kernels on disk.

A kernel's files carry a stamp of everything that it was compiled from, so that none is loaded that
does not fit. A process that needs a kernel waits while another one compiles it.
"""

from __future__ import annotations

import ast
import hashlib
import secrets
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from filelock import BaseFileLock, FileLock, Timeout
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock

FOLDER = Path(__file__).parent

COMPILED_IN = (
    "baselines/thermonerf/hash_grid.py",
    "field/spherical_harmonics.py",
    "rasterizer/contract.py",
    "rasterizer/splat.py",
)
"""Files outside of ``kernels`` whose constants are compiled into kernels."""

LOCK_SECONDS = 300.0
"""How long a process waits for another one to compile a kernel, before it compiles it itself."""


def keep_on_disk(dispatcher: Any) -> None:
    """Have a jitted function load its compiled versions from disk, or compile and save them.

    Of several processes that need the same one, one compiles it. The lock is the operating
    system's, so it ends with its process; a process that waits for longer than ``LOCK_SECONDS``,
    or whose file system has no locks, compiles without one.
    """
    dispatcher._cache = kernel_cache = KernelCache(dispatcher.py_func)
    compile_signature: Callable[[Any], Any] = dispatcher.compile

    def compile_and_unlock(signature: Any) -> Any:
        with global_compiler_lock, kernel_cache.unlocking():
            return compile_signature(signature)

    dispatcher.compile = compile_and_unlock


class KernelCache(FunctionCache):
    """Numba's cache of one function, with a stamp over all sources and a lock."""

    _patience = LOCK_SECONDS
    """Seconds to wait, of all kernels; 0 once a wait has timed out."""

    def __init__(self, py_func: Any) -> None:
        self._impl_class = _StampedNames
        super().__init__(py_func)
        self._stamp = self._impl.stamp
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, self._stamp)
        self._held = ExitStack()

    @contextmanager
    def unlocking(self) -> Iterator[None]:
        """At the end of this block, release the lock if ``load_overload`` took it within."""
        outer = self._held
        try:
            with ExitStack() as self._held:
                yield
        finally:
            self._held = outer

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled version for a signature; None if it has to be made, then with the lock."""
        found = super().load_overload(sig, target_context)
        if found is None and self._locked():  # another process may have just saved it
            found = super().load_overload(sig, target_context)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a compiled version, and delete those that an older file was compiled to."""
        super().save_overload(sig, data)
        module = self._impl.filename_base.partition(".")[0]
        for path in Path(self._cache_path).glob(f"{module}.*"):
            if path.suffix in (".nbi", ".nbc", ".lock") and self._stamp not in path.name:
                with suppress(OSError):  # in use, on Windows
                    path.unlink(missing_ok=True)

    def _locked(self) -> bool:
        """Wait for the lock; False if it cannot be had."""
        try:
            self._held.enter_context(self._lock.acquire(KernelCache._patience, poll_interval=0.01))
        except Timeout:
            KernelCache._patience = 0.0
        except (OSError, NotImplementedError):  # a read-only folder; a file system without locks
            return False
        return True

    @cached_property
    def _lock(self) -> BaseFileLock:
        path = Path(self._cache_path, f"{self._impl.filename_base}.lock")
        return FileLock(path, thread_local=False)


class _StampedNames(CompileResultCacheImpl):
    """Names files by the stamp as well, so that those of two versions are never mixed."""

    def __init__(self, py_func: Any) -> None:
        self.stamp = source_stamp(Path(py_func.__code__.co_filename))
        super().__init__(py_func)

    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        return f"{super().get_filename_base(fullname, abiflags)}-{self.stamp}"


class _Files(IndexDataCacheFile):
    """Gives each compiled version a name of its own: numbered ones, written by two processes
    without a lock, could be mistaken for each other."""

    def _data_name(self, number: int) -> str:
        return super()._data_name(secrets.randbits(48))


@cache
def source_stamp(path: Path) -> str:
    """A digest of a kernel file and of all that is compiled into its kernels: the files of
    ``kernels`` that it imports, directly or not, and those of ``COMPILED_IN``."""
    digest = hashlib.sha256()
    for file in sorted(_sources(path)):
        content = file.read_bytes()
        digest.update(f"{file.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


def _sources(path: Path) -> set[Path]:
    found: set[Path] = set()
    waiting = [path]
    while waiting:
        file = waiting.pop()
        if file not in found:
            found.add(file)
            waiting += _imports(file)
    return found


@cache
def _imports(path: Path) -> tuple[Path, ...]:
    """Files that can be compiled into kernels, of those that a file imports; this one cannot."""
    compiled_in = {FOLDER.parent / name for name in COMPILED_IN}
    files = {_file_of(name) for name in _imported_names(ast.parse(path.read_bytes()))}
    return tuple(
        file
        for file in files
        if file and (FOLDER in file.parents or file in compiled_in) and file != Path(__file__)
    )


def _imported_names(tree: ast.Module) -> Iterator[str]:
    """Full names of what is imported anywhere in a file, all absolute."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _file_of(name: str) -> Path | None:
    """The file of the package that defines a module or a name in a module."""
    package, *parts = name.split(".")
    if package != FOLDER.parent.name:
        return None
    for count in (len(parts), len(parts) - 1):
        path = FOLDER.parent.joinpath(*parts[: max(count, 0)])
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if file.exists():
                return file
    return None
