"""Compiled Numba kernels on disk.

A kernel's files carry a stamp of everything that it was compiled from, so that none is loaded that
does not fit. A process that needs a kernel waits while another one compiles it. Numba runs what it
loads, so a folder is used only if nobody else can write to it.
"""

from __future__ import annotations

import ast
import hashlib
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from enum import Enum
from functools import cache, cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import llvmlite
import numpy as np
from filelock import BaseFileLock, FileLock, Timeout
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock

from mrgs.errors import MrgsWarning
from mrgs.system.private import require_private

FOLDER = Path(__file__).parent

COMPILER = (
    llvmlite.__version__,
    *(getattr(config, name, None) for name in ("OPT", "BOUNDSCHECK", "DEBUGINFO_DEFAULT")),
    *(getattr(config, name, None) for name in ("LOOP_VECTORIZE", "SLP_VECTORIZE", "ENABLE_AVX")),
)
"""Settings of the compiler that change its code; Numba itself knows its version and the CPU."""

_CONSTANTS = (bool, int, float, complex, str, bytes, np.generic)

_ABANDONED_S = 3600.0
"""Age of a temporary file whose process has died while it wrote a kernel."""

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
    """Numba's cache of one function, with a stamp over all that is compiled in, and a lock.

    The folder is looked for when the function is first compiled, for only then all constants have
    their values. Where there is none, kernels are compiled in every process.
    """

    _patience = LOCK_SECONDS
    """Seconds to wait, of all kernels; 0 once a wait has timed out."""

    def __init__(self, py_func: Any) -> None:
        self._py_func = py_func
        self._held = ExitStack()

    @cached_property
    def _is_open(self) -> bool:
        """Whether there is a folder for this kernel."""
        self._impl_class = _StampedNames
        try:
            super().__init__(self._py_func)
        except RuntimeError:  # Numba's word for it
            _warn_not_kept("there is no folder to keep them in that only you can write to")
            return False
        self._stamp = self._impl.stamp
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, self._stamp)
        return True

    @property
    def cache_path(self) -> Any:
        """The folder; None where there is none."""
        return self._cache_path if self._is_open else None

    @property
    def is_saved(self) -> bool:
        """Whether a compiled version for this source is on disk; asked once all modules that the
        kernel uses are imported."""
        return self._is_open and Path(self._cache_path, self._cache_file._index_name).is_file()

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
        if not self._is_open:
            return None
        found = super().load_overload(sig, target_context)
        if found is None and self._locked():  # another process may have just saved it
            found = super().load_overload(sig, target_context)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a compiled version, and delete those that an older file was compiled to."""
        if not self._is_open:
            return
        try:
            super().save_overload(sig, data)
        except OSError as error:  # a full disk
            _warn_not_kept(f"{self._cache_path} cannot be written ({error.strerror})")
        module = self._impl.filename_base.partition(".")[0]
        with suppress(OSError):
            for path in Path(self._cache_path).glob(f"{module}.*"):
                if self._is_outdated(path):
                    with suppress(OSError):  # in use, on Windows
                        path.unlink(missing_ok=True)

    def _is_outdated(self, path: Path) -> bool:
        if ".tmp." in path.name:
            return time.time() - path.stat().st_mtime > _ABANDONED_S
        return path.suffix in (".nbi", ".nbc", ".lock") and self._stamp not in path.name

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


@cache
def _warn_not_kept(reason: str) -> None:
    warnings.warn(
        f"compiled kernels are not kept, so each start takes up to a minute longer: {reason}; set "
        f"NUMBA_CACHE_DIR to a folder of your own",
        MrgsWarning,
        stacklevel=2,
    )


def _private(locator: Any) -> Any:
    """One of Numba's ways to find a folder, restricted to folders that only the user can write."""

    class PrivateLocator(locator):
        def ensure_cache_path(self) -> None:
            require_private(Path(self.get_cache_path()))
            super().ensure_cache_path()

    return PrivateLocator


class _StampedNames(CompileResultCacheImpl):
    """Names files by the stamp as well, so that those of two versions are never mixed."""

    _locator_classes = tuple(map(_private, CompileResultCacheImpl._locator_classes))

    def __init__(self, py_func: Any) -> None:
        self.stamp = stamp_of(Path(py_func.__code__.co_filename))
        super().__init__(py_func)

    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        return f"{super().get_filename_base(fullname, abiflags)}-{self.stamp}"


class _Files(IndexDataCacheFile):
    """An index, and a file for each compiled version, named by its checksum.

    What is damaged counts as missing. Numbered files, written by two processes without a lock,
    could be mistaken for each other.
    """

    def save(self, key: Any, data: Any) -> None:
        content = self._dump(data)
        name = self._data_name(_checksum(content))
        with self._open_for_write(self._data_path(name)) as file:
            file.write(content)
        self._save_index({**self._load_index(), key: name})

    def load(self, key: Any) -> Any:
        name = self._load_index().get(key)
        if name is None:
            return None
        try:
            content = Path(self._data_path(name)).read_bytes()
            is_whole = name == self._data_name(_checksum(content))
            return self._load_data(name) if is_whole else None
        except OSError:  # removed, or unreadable
            return None

    def _load_index(self) -> dict[Any, str]:
        try:
            return super()._load_index()
        except Exception:  # what a damaged index raises depends on where it is damaged
            return {}


def _checksum(content: bytes) -> int:
    return int.from_bytes(hashlib.sha256(content).digest()[:8], "little")


def stamp_of(path: Path) -> str:
    """A digest of all that is compiled into the kernels of a file.

    That is the code of the files of ``kernels`` that it imports, directly or not, the constants in
    them and those that they import from elsewhere in the package, by their values, and the settings
    of the compiler.
    """
    digest = hashlib.sha256(repr(COMPILER).encode())
    for file in sorted(_sources(path)):
        content = file.read_bytes()
        digest.update(f"{file.name} {len(content)}\n".encode() + content)
        for name, value in _constants(file):
            digest.update(f"{name} {value}\n".encode())
    return digest.hexdigest()[:16]


def _sources(path: Path) -> set[Path]:
    found: set[Path] = set()
    waiting = [path]
    while waiting:
        file = waiting.pop()
        if file not in found:
            found.add(file)
            files = map(_file_of, _imported_names(file))
            waiting += [each for each in files if each and FOLDER in each.parents]
    return found - {Path(__file__)}


def _constants(file: Path) -> Iterator[tuple[str, str]]:
    """Names and values of the constants of a loaded module, and of those that it can reach in the
    modules that it imports."""
    module = sys.modules.get(_module_name(file))
    for name, value in sorted(vars(module).items()) if module is not None else ():
        yield from _described(name, value)
        if isinstance(value, ModuleType) and _is_ours(value.__name__):
            for inner, constant in sorted(vars(value).items()):
                yield from _described(f"{name}.{inner}", constant)


def _described(name: str, value: Any) -> Iterator[tuple[str, str]]:
    """A constant as text; nothing for what cannot be compiled in, or is code."""
    if name.rpartition(".")[2].startswith("__"):
        return
    if isinstance(value, np.ndarray):
        yield name, f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    elif isinstance(value, (*_CONSTANTS, type(None))):
        yield name, repr(value)
    elif isinstance(value, tuple):
        for place, item in enumerate(value):
            yield from _described(f"{name}[{place}]", item)
    elif isinstance(value, type) and issubclass(value, Enum):
        yield name, repr(list(value))
    elif isinstance(value, type) and issubclass(value, tuple):
        yield name, repr(getattr(value, "_fields", ()))


def _module_name(file: Path) -> str:
    parts = file.relative_to(FOLDER.parents[1]).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _is_ours(name: str) -> bool:
    return name.partition(".")[0] == FOLDER.parent.name


@cache
def _imported_names(file: Path) -> tuple[str, ...]:
    """Full names of what is imported anywhere in a file, all absolute."""
    names: list[str] = []
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(names)


@cache
def _file_of(name: str) -> Path | None:
    """The file of the package that defines a module or a name in a module."""
    if not _is_ours(name):
        return None
    parts = name.split(".")[1:]
    for count in (len(parts), len(parts) - 1):
        path = FOLDER.parent.joinpath(*parts[: max(count, 0)])
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if file.exists():
                return file
    return None
