"""Stages that are done once: each result is kept with the fingerprint of everything that it follows
from."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from filelock import FileLock, Timeout

from mrgs.data.files import scene_error
from mrgs.errors import RunError
from mrgs.prepare.contract import Progress, StageReport
from mrgs.prepare.store import fingerprint, load, save

Result = TypeVar("Result")

WORK = "prepare"
"""The folder in the scene's folder that holds what the stages found."""

FORMAT = 1
"""Raised when a stage's results change their meaning: those of before are then found anew."""

_BLOCK_BYTES = 2**20


@dataclass(frozen=True)
class Told:
    """What a result says to the user.

    Attributes:
        lines: one sentence each, the first one the most important.
        warnings: sentences that the user should read.
    """

    lines: tuple[str, ...]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Stage(Generic[Result]):
    """A step of the way from photos to a scene.

    Attributes:
        title: shown to the user, and the name of its file.
        kind: the type of its result, or that type or None; ``store`` can write it.
        depends: values that the result follows from.
        make: finds the result.
        tell: what it says.
        files: what else the result consists of; it is made again if one is missing.
    """

    title: str
    kind: Any
    depends: tuple[Any, ...]
    make: Callable[[Progress], Result]
    tell: Callable[[Result], Told]
    files: Callable[[Result], Iterable[Path]] = field(default=lambda result: ())


class Stages:
    """Runs stages, or takes what an earlier call found.

    Args:
        folder: keeps the results.
        progress: called with "stage: step", and how many of the step's parts are done and there
            are.
        report: called with each stage's report when it is done.
    """

    def __init__(
        self, folder: Path, progress: Progress | None, report: Callable[[StageReport], None] | None
    ) -> None:
        self._folder = folder
        self._progress = progress or (lambda step, done, total: None)
        self._report = report or (lambda done: None)
        self.reports: list[StageReport] = []

    def run(self, stage: Stage[Result]) -> Result:
        """The stage's result: the stored one if nothing that it follows from has changed, else a
        new one."""
        file = self._file(stage.title)
        made_from = fingerprint(FORMAT, stage.title, *stage.depends)
        stored = load(file, stage.kind, made_from)
        if stored is not None and all(path.is_file() for path in stage.files(stored.value)):
            self._tell(stage, stored.value, 0.0, reused=True)
            return stored.value
        self._progress(stage.title, 0, 0)
        started = time.perf_counter()
        result = stage.make(
            lambda step, done, total: self._progress(f"{stage.title}: {step}", done, total)
        )
        save(file, result, made_from)
        self._tell(stage, result, time.perf_counter() - started, reused=False)
        return result

    def forget(self, title: str) -> None:
        """Have a stage done again, whatever it depends on."""
        self._file(title).unlink(missing_ok=True)

    def _file(self, title: str) -> Path:
        return self._folder / f"{title.replace(' ', '_')}.safetensors"

    def _tell(self, stage: Stage[Result], result: Result, seconds: float, reused: bool) -> None:
        told = stage.tell(result)
        report = StageReport(stage.title, told.lines, told.warnings, seconds, reused)
        self.reports.append(report)
        self._report(report)


@contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Keep a second call out of the folder, which is made if need be.

    Raises:
        RunError: the folder cannot be made, or another call is at work in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / ".lock", timeout=0)
        lock.acquire()
    except Timeout:
        raise RunError(
            f"{folder.parent} is being prepared by another run: wait for it, or choose another "
            f"folder"
        ) from None
    except OSError as error:
        raise RunError(
            f"{folder} cannot be written ({error.strerror}): free the place or choose another "
            f"folder"
        ) from None
    with lock:
        yield


def stamps(folder: Path) -> tuple[tuple[str, int, int, int], ...]:
    """Path, bytes and times (ns) of the last change of content and of rights, of every file below a
    folder, sorted.

    Links are followed. Hidden files and folders are left out, as they are when photos are looked
    for.

    Raises:
        SceneError: the folder cannot be listed.
    """
    try:
        found = []
        for parent, folders, names in os.walk(folder, onerror=_raise):
            folders[:] = [name for name in folders if not name.startswith(".")]
            for name in names:
                path = Path(parent, name)
                if not name.startswith("."):
                    status = path.stat() if path.exists() else path.lstat()
                    times = status.st_mtime_ns, status.st_ctime_ns
                    found.append((path.relative_to(folder).as_posix(), status.st_size, *times))
        return tuple(sorted(found))
    except OSError as error:
        raise scene_error(
            error.filename or folder,
            f"cannot be read ({error.strerror}); give a folder of photos that is readable",
        ) from None


def digest(path: Path) -> str:
    """A digest of a file's content; empty if it cannot be read, which whoever reads it next will
    tell."""
    try:
        found = hashlib.sha256()
        with open(path, "rb") as file:
            while block := file.read(_BLOCK_BYTES):
                found.update(block)
        return found.hexdigest()
    except OSError:
        return ""


def _raise(error: OSError) -> None:
    raise error
