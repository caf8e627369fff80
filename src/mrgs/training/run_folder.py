"""The folder of a run: its layout, its lock, its log."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

from filelock import FileLock, Timeout

from mrgs.errors import ConfigError, FolderInUseError, RunError, SceneError, warn_user
from mrgs.system.atomic import remove_abandoned, write_error, write_text
from mrgs.system.strict_yaml import parse_yaml, write_yaml
from mrgs.system.wording import listed

CHECKPOINTS_KEPT = 2


@runtime_checkable
class RunConfig(Protocol):
    """The fields of every method's configuration, which is a dataclass."""

    @property
    def method(self) -> str:
        """The method's name."""

    @property
    def max_steps(self) -> int:
        """Training steps."""

    @property
    def resolution(self) -> int | None:
        """Images wider than this many pixels are reduced to it; None keeps them."""

    @property
    def seed(self) -> int:
        """Seed of every random choice."""

    @property
    def checkpoint_every(self) -> int:
        """Steps between checkpoints."""


_LEFT_BEHIND = {"checkpoints", "tensorboard", "blocks", "survey.yaml", "marks.json"}
"""What may lie in a folder before it is a run: what an earlier one left, and what was stated for
it."""

_EVERY_CONFIG_HAS = {"method", "max_steps", "resolution", "seed", "checkpoint_every"}

Config = TypeVar("Config")
ReadConfig = Callable[[str, str], Config]
"""From the text of a config.yaml and the file's name, for messages."""

LogMirror = Callable[[Mapping[str, Any]], None]
"""Receives each entry of the log."""


class RunFolder:
    """``config.yaml``, ``log.jsonl``, ``checkpoints/step_NNNNNN.safetensors``; scores and pictures
    go beside them."""

    def __init__(self, path: str | Path) -> None:
        if not isinstance(path, (str, os.PathLike)):
            raise RunError(
                f"the run's folder must be a path, not {type(path).__name__}; other parameters "
                f"follow by name, such as config="
            )
        self.path = Path(path).absolute()  # whatever the current folder is later
        self._log_mirrors: list[LogMirror] = []

    def __repr__(self) -> str:
        return f"RunFolder({str(self.path)!r})"

    @property
    def config_file(self) -> Path:
        """The run's whole configuration."""
        return self.path / "config.yaml"

    @property
    def log_file(self) -> Path:
        """One JSON object per logged step."""
        return self.path / "log.jsonl"

    def checkpoint_file(self, step: int) -> Path:
        """Path of the checkpoint of a step."""
        return self.path / "checkpoints" / f"step_{step:06d}.safetensors"

    def checkpoints(self) -> list[Path]:
        """All checkpoints, oldest first."""
        found = (self.path / "checkpoints").glob("step_*.safetensors")
        numbered = [path for path in found if step_named(path) is not None]
        return sorted(numbered, key=lambda path: (len(path.name), path))

    def newest_checkpoint(self) -> Path:
        """The checkpoint to continue or to use.

        Raises:
            RunError: the folder is not a run, or has no checkpoint yet.
        """
        self._require_config()
        found = self.checkpoints()
        if not found:
            raise RunError(f"{self.path} has no checkpoint yet: train it first")
        return found[-1]

    def set_aside(self, checkpoint: Path) -> Path:
        """Rename a damaged checkpoint, so that it no longer counts as the newest; its new path.

        Raises:
            RunError: the folder cannot be written.
        """
        aside = checkpoint.with_name(f"{checkpoint.name}.damaged")
        with self._writing():
            checkpoint.replace(aside)
        return aside

    def drop_old_checkpoints(self) -> None:
        """Keep the newest two."""
        with self._writing():
            for path in self.checkpoints()[:-CHECKPOINTS_KEPT]:
                path.unlink()

    def require_new(self) -> None:
        """A folder without checkpoints may become a new run: one that died before its first leaves
        nothing to keep.

        Raises:
            RunError: the folder holds a run.
        """
        if self.checkpoints():
            raise RunError(
                f"{self.path} already holds a run: resume it, or choose another folder",
                options=("resume", "output"),
            )
        if self.config_file.exists():
            if not self._config_values().keys() >= _EVERY_CONFIG_HAS:
                raise RunError(
                    f"{self.path} holds a config.yaml that is not a run's: choose another folder",
                    options=("output",),
                )
        elif self.log_file.exists():
            raise RunError(
                f"{self.path} holds a log.jsonl that is not a run's: choose another folder",
                options=("output",),
            )
        elif foreign := self._foreign():
            raise RunError(
                f"{self.path} holds something else ({listed(foreign)}): choose a new folder",
                options=("output",),
            )

    def _foreign(self) -> list[str]:
        """Names of what no run leaves behind; hidden files do not count."""
        if not self.path.is_dir():
            return []
        names = sorted(path.name for path in self.path.iterdir())
        return [name for name in names if name not in _LEFT_BEHIND and not name.startswith(".")]

    def start(self, config: RunConfig) -> None:
        """Make the folder a new run.

        Raises:
            RunError: the folder holds a run, or cannot be written.
        """
        self.require_new()
        with self._writing():
            self.log_file.unlink(missing_ok=True)
        write_text(self.config_file, write_yaml(config))

    @property
    def method(self) -> str:
        """The name of the run's method.

        Raises:
            RunError: the folder is not a run.
        """
        values = self.read_config(parse_yaml)
        if not isinstance(values, dict) or not isinstance(values.get("method"), str):
            raise RunError(
                f"{self.path} is not a run: its config.yaml names no method; fix the file or "
                f"retrain"
            )
        name: str = values["method"]
        return name

    def read_config(self, read: ReadConfig[Config]) -> Config:
        """The run's configuration.

        Args:
            read: the method's.

        Raises:
            RunError: the folder is not a run, or its configuration cannot be used.
        """
        try:
            return read(self._config_text(), str(self.config_file))
        except ConfigError as error:
            raise RunError(f"{error}; fix the file or retrain") from error

    def warn_if_incomplete(self, config: RunConfig) -> None:
        """A run's config.yaml names every setting; one that was cut off may still be read.

        Args:
            config: what was read from it.

        Warns:
            MrgsWarning: it lacks some, for which the defaults are used.
        """
        whole = parse_yaml(write_yaml(config), "")
        have = set(_names_in(self._config_values()))
        missing = [name for name in _names_in(whole) if name not in have]
        if missing:
            warn_user(
                f"{self.config_file} lacks {listed(missing)}, for which the defaults are used: "
                f"restore it if it was cut off"
            )

    def _require_config(self) -> None:
        if self.config_file.is_file():
            return
        inside = self._runs_inside()
        if len(inside) == 1:
            raise RunError(
                f"{self.path} is not a run itself; the model is in {inside[0]}: give that folder"
            )
        if inside:
            raise RunError(
                f"{self.path} is not a run itself; there are models in "
                f"{listed([str(folder) for folder in inside])}: give one of these folders"
            )
        raise RunError(
            f"{self.path} is not a run: it has no config.yaml; name a folder that `mrgs train` "
            f"wrote"
        )

    def _runs_inside(self) -> list[Path]:
        """The trained runs among the folders in this one, as where `mrgs run` keeps its results."""
        try:
            folders = sorted(path.parent for path in self.path.glob("*/config.yaml"))
        except OSError:
            return []
        return [folder for folder in folders if RunFolder(folder).checkpoints()]

    def _config_text(self) -> str:
        self._require_config()
        try:
            return self.config_file.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise RunError(
                f"{self.path} is not a run: its config.yaml cannot be read; name a folder that "
                f"`mrgs train` wrote"
            ) from error

    def _config_values(self) -> dict[str, Any]:
        """The outermost entries of config.yaml; empty where it holds something else."""
        try:
            values = self.read_config(parse_yaml)
        except RunError:
            return {}
        return values if isinstance(values, dict) else {}

    def append_log(self, entry: dict[str, Any]) -> None:
        """Add a line to the log; numbers that are not finite become null.

        Raises:
            RunError: the log cannot be written.
        """
        finite = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in entry.items()
        }
        with self._writing(), self.log_file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(finite, allow_nan=False) + "\n")
        for mirror in self._log_mirrors:
            mirror(finite)

    @contextmanager
    def log_mirrored(self, mirror: LogMirror) -> Iterator[None]:
        """Within this block, hand over each entry of the log as well."""
        self._log_mirrors.append(mirror)
        try:
            yield
        finally:
            self._log_mirrors.remove(mirror)

    def cut_log(self, step: int) -> None:
        """Drop the lines behind a step, which a resumed run writes again."""
        if not self.log_file.exists():
            return
        lines = self.log_file.read_text(encoding="utf-8", errors="replace").splitlines()
        kept = [line for line in lines if _step_of(line) <= step]
        write_text(self.log_file, "".join(line + "\n" for line in kept))

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder for this process; the system gives it back when the process ends, however
        it ends.

        Raises:
            RunError: another process holds it, or the folder cannot be made.
        """
        lock = FileLock(self.path / ".lock")
        try:
            with self._writing():
                self.path.mkdir(parents=True, exist_ok=True)
                lock.acquire(timeout=0)
        except Timeout:
            raise FolderInUseError(
                f"{self.path} is in use by another run: wait for it, or choose another folder",
                options=("output",),
            ) from None
        try:
            yield
        finally:
            lock.release()

    @contextmanager
    def training(self, config: RunConfig, resume: bool) -> Iterator[None]:
        """Hold the folder while a run in it is trained: a new one, unless ``resume``.

        A run that ends before its first checkpoint, because of the scene or of Ctrl-C, leaves
        nothing.

        Raises:
            RunError: another process holds the folder, or it cannot be used.
        """
        with self.locked():
            remove_abandoned(self.path)
            if self.log_file.exists() and not self.log_file.is_file():  # a pipe would block
                raise RunError(
                    f"{self.log_file} is not a file: move it away, or choose another folder",
                    options=("output",),
                )
            if not resume:
                self.start(config)
            try:
                yield
            except (SceneError, KeyboardInterrupt):  # photos are decoded when their turn comes
                if not self.checkpoints():
                    self.discard()
                raise

    def discard(self) -> None:
        """Remove a run that never came to a checkpoint, and the folder if nothing else is in it;
        under the lock."""
        for name in ("config.yaml", "log.jsonl"):
            (self.path / name).unlink(missing_ok=True)
        with suppress(OSError):  # something else is in it; on Windows, the lock while it is held
            (self.path / ".lock").unlink(missing_ok=True)
            self.path.rmdir()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn what the file system refuses into an error with a remedy."""
        try:
            yield
        except Timeout:
            raise
        except OSError as error:
            raise write_error(self.path, error, options=("output",)) from error


class TemporaryRunFolder(RunFolder):
    """A run's folder among the system's temporary files, removed with this object, or with the
    process once it is kept."""

    _kept: ClassVar[list[TemporaryRunFolder]] = []

    def __init__(self) -> None:
        super().__init__(tempfile.mkdtemp(prefix="mrgs-"))
        weakref.finalize(self, _remove_own, self.path, os.getpid())

    def keep(self) -> None:
        """Keep the folder as long as the process lives."""
        self._kept.append(self)


def _remove_own(folder: Path, owner: int) -> None:
    """Remove a folder, unless this process is a fork of the one that made it."""
    if os.getpid() == owner:
        shutil.rmtree(folder, ignore_errors=True)


def step_named(checkpoint: Path) -> int | None:
    """The step in a checkpoint's name; None if it is not named like one."""
    found = re.fullmatch(r"step_([0-9]{1,18})\.safetensors", checkpoint.name)
    return None if found is None else int(found[1])


def _names_in(values: Any, prefix: str = "") -> Iterator[str]:
    """The dotted names of all entries of nested mappings."""
    if isinstance(values, dict):
        for name, value in values.items():
            yield f"{prefix}{name}"
            yield from _names_in(value, f"{prefix}{name}.")


def _step_of(line: str) -> int:
    """The step of a log line; a torn last line counts as behind everything."""
    try:
        return int(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return 2**62
