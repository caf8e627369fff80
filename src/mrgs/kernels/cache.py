"""Compiled Numba kernels on disk, in Numba's own cache.

Each version of what kernels are compiled from has a folder of its own, named by a digest: their
source files, the constants that they take from the plain definitions, the compiler and the
processor. So no edit leaves a stale kernel behind. Numba unpickles what it loads, so the cache is
used only if it belongs to this user and nobody else can write to it.
"""

from __future__ import annotations

import hashlib
import os
import platform
import secrets
import shutil
import stat
import warnings
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite import binding
from numba.core import config
from numba.core.caching import FunctionCache

from mrgs.errors import MrgsWarning
from mrgs.field import spherical_harmonics
from mrgs.method.camera_model import point_spread
from mrgs.rasterizer import contract, splat

FOLDER = Path(__file__).parent

CONSTANTS = (contract, splat, spherical_harmonics, point_spread)
"""Modules outside of this package whose numbers are compiled into its kernels."""

COMPILER = (
    *(module.__version__ for module in (numba, llvmlite, np)),
    platform.python_version(),
    binding.get_host_cpu_name(),
    binding.get_host_cpu_features().flatten(),
    *(getattr(config, name, None) for name in ("OPT", "BOUNDSCHECK", "DEBUGINFO_DEFAULT")),
    *(getattr(config, name, None) for name in ("LOOP_VECTORIZE", "SLP_VECTORIZE", "ENABLE_AVX")),
)
"""What decides on the machine code besides the sources."""

VERSIONS_KEPT = 12
"""Number of versions whose compiled kernels are kept, the most recently used ones."""

_PROCESS = secrets.token_hex(4)


def keep_on_disk(dispatcher: Any) -> None:
    """Make a jitted function load its compiled versions from disk, and save new ones there."""
    if version_folder(_root(dispatcher.py_func.__code__.co_filename)) is not None:
        dispatcher._cache = KernelCache(dispatcher.py_func)


def _root(file: str) -> Path:
    """The folder of whose sources a kernel is compiled: this package, or its own file's."""
    return FOLDER if FOLDER in Path(file).parents else Path(file).parent


class _KernelPlace:
    """Where Numba keeps a function: in the folder of its version, whose name says all that the code
    depends on. Numba's own places also go by path and date of the source, in each new checkout."""

    def __init__(self, root: Path, version: Path, file: Path, first_line: int) -> None:
        self._root, self._version, self._first_line = root, version, first_line
        self._folder = version / file.parent.relative_to(root)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _KernelPlace | None:
        root = _root(py_file)
        version, first_line = version_folder(root), py_func.__code__.co_firstlineno
        return None if version is None else cls(root, version, Path(py_file), first_line)

    def is_current(self) -> bool:
        """Whether the sources are still those that this process has imported."""
        return digest_of(self._root) == self._version.name

    def ensure_cache_path(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> int:
        return 0

    def get_disambiguator(self) -> str:
        return str(self._first_line)


class _KernelFiles(FunctionCache._impl_class):
    _locator_classes = (_KernelPlace,)


class KernelCache(FunctionCache):
    """Numba's cache of one function; a file that cannot be read or written costs time only."""

    _impl_class = _KernelFiles

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)
        # Numba numbers the files of a function by its signatures. Two processes would give the same
        # number to different signatures, and one would run the code of the other.
        name = f"{self._impl.filename_base}.{_PROCESS}"
        self._cache_file._data_name_pattern = name + "-{number:d}.nbc"

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled version for a signature; None if it is missing or damaged."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # the error of a damaged file depends on where it is damaged
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a compiled version, unless its sources changed meanwhile; warn if that fails."""
        try:
            if self._impl.locator.is_current():
                super().save_overload(sig, data)
        except OSError as error:
            _warn_not_kept(f"{self.cache_path} cannot be written ({error.strerror})")


def are_compiled() -> bool:
    """Whether this package's kernels are on disk; else compiling them takes about a minute."""
    if config.DISABLE_JIT:
        return True
    folder = version_folder(FOLDER)
    return folder is not None and any(folder.rglob("*.nbi"))


@cache
def version_folder(sources: Path) -> Path | None:
    """The cache for kernels whose sources are in a folder; None, with a warning, without a place
    that only this user can write to. Versions that have not been used for long are deleted."""
    try:
        chosen = os.environ.get("NUMBA_CACHE_DIR")
        root = Path(chosen or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mrgs"
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(root):
            raise PermissionError(f"other users can write to {root}")
        folder = root / digest_of(sources)
        folder.mkdir(exist_ok=True)
        os.utime(folder)
        by_age = sorted(root.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home folder
        _warn_not_kept(str(error))
        return None
    for old in by_age[VERSIONS_KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
    return folder


def digest_of(sources: Path) -> str:
    """A digest of everything that is compiled into a folder's kernels: this package's kernels, its
    own files and, in a package, the files of the package above it."""
    files = set(FOLDER.rglob("*.py"))
    if FOLDER not in (sources, *sources.parents):
        files |= set(sources.glob("*.py"))
        if (sources / "__init__.py").exists():
            files |= set(sources.parent.glob("*.py"))
    numbers = [
        (module.__name__, name, value)
        for module in CONSTANTS
        for name, value in sorted(vars(module).items())
        if isinstance(value, (int, float, tuple))
    ]
    digest = hashlib.sha256(repr((COMPILER, numbers)).encode())
    for file in sorted(files):
        content = file.read_bytes()
        digest.update(f"{file.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


def _is_private(folder: Path) -> bool:
    """Whether only this user can write to a folder."""
    status = folder.stat()
    others_write = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return status.st_uid == os.geteuid() and not others_write


@cache
def _warn_not_kept(reason: str) -> None:
    warnings.warn(
        f"compiled kernels are not kept, so each start takes up to a minute longer: {reason}; set "
        f"NUMBA_CACHE_DIR to a folder of your own",
        MrgsWarning,
        stacklevel=2,
    )
