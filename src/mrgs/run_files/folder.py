"""The folder of a run: its layout, its lock, its log."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol, TypeAlias, TypeVar, cast, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from mrgs.errors import (
    ConfigError,
    DamagedCheckpointError,
    FolderInUseError,
    RunError,
    SceneError,
    warn_user,
)
from mrgs.system.atomic import LOCK, locked, remove_abandoned, write_error, write_text
from mrgs.system.disk import open_regular, read_text
from mrgs.system.strict_yaml import flat, parse_yaml, write_yaml
from mrgs.system.wording import listed

CHECKPOINTS_KEPT = 2

Pictures: TypeAlias = Mapping[str, UInt8[np.ndarray, "h w 3"]]
"""Pictures for TensorBoard by name, 8-bit RGB."""

TENSORBOARD = "tensorboard"
"""Folder of the log for TensorBoard, in the run's folder."""

_LEFT_BEHIND = {"checkpoints", TENSORBOARD, "blocks", "survey.yaml", "marks.json"}
"""Files that may be there before a run: an earlier one's, and what the user has entered for it."""

_CUSTOM, _LONGEST_CUSTOM = "# custom ", 300
"""What begins a comment of config.yaml that names a part from Python, and how long it may be."""

_EVERY_CONFIG_HAS = {"method", "max_steps", "resolution", "seed", "checkpoint_every"}


@runtime_checkable
class RunConfig(Protocol):
    """The fields of every method's configuration, which is a dataclass."""

    @property
    def method(self) -> str:
        """The method's name."""

    @property
    def max_steps(self) -> int:
        """Number of training steps."""

    @property
    def resolution(self) -> int | None:
        """Images wider than this many pixels are downscaled to it; None keeps them."""

    @property
    def seed(self) -> int:
        """Seed of every random choice."""

    @property
    def checkpoint_every(self) -> int:
        """Steps between checkpoints."""


T = TypeVar("T")
C = TypeVar("C", bound=RunConfig)

ReadConfig = Callable[[str, str], T]
"""Parses the text of a config.yaml; the second argument is the file's name, for messages."""


class RunFolder:
    """``config.yaml``, ``log.jsonl``, ``checkpoints/step_NNNNNN.safetensors``; scores and pictures
    go beside them."""

    def __init__(self, path: str | Path) -> None:
        if not isinstance(path, (str, os.PathLike)):
            raise RunError(
                f"the run's folder must be a path, not {type(path).__name__}; other parameters "
                f"follow by name, such as config="
            )
        self.path = Path(path).absolute()  # so that a later change of directory does not matter
        self._tensorboard: Any = None

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
        """The last checkpoint. RunError if the folder is not a run, or has no checkpoint yet."""
        self._require_config()
        found = self.checkpoints()
        if not found:
            raise RunError(f"{self.path} has no checkpoint yet: train it first")
        return found[-1]

    def load_newest(self, load: Callable[[Path], T], *, set_aside: bool = False) -> T:
        """Load the newest checkpoint, or an older one where ``load`` raises DamagedCheckpointError,
        with a MrgsWarning. Damaged ones are renamed to ``*.damaged`` if they are to be
        ``set_aside``, because newer ones will be written. RunError if there is no checkpoint, all
        are damaged, or the newest undamaged one cannot be used."""
        self.newest_checkpoint()
        damaged: list[DamagedCheckpointError] = []
        for path in reversed(self.checkpoints()):
            try:
                found = load(path)
            except DamagedCheckpointError as error:
                damaged.append(error)
                continue
            except RunError:
                if path in self.checkpoints():
                    raise
                return self.load_newest(load, set_aside=set_aside)  # newer ones have replaced it
            for one in damaged:
                text = f"{one.path} is not a whole checkpoint ({one.reason}); {path.name} is used"
                if set_aside:
                    with self._writing():
                        aside = one.path.replace(f"{one.path}.damaged")
                    text += f"; it is kept as {aside.name}"
                warn_user(text)
            return found
        raise RunError(
            f"{self.path} has no checkpoint that is whole ({damaged[0].reason}): restore one from "
            f"a copy, or retrain into another folder"
        )

    def drop_old_checkpoints(self) -> None:
        """Remove all but the newest checkpoints."""
        with self._writing():
            for path in self.checkpoints()[:-CHECKPOINTS_KEPT]:
                path.unlink()

    def require_new(self) -> None:
        """Check that the folder may become a new run; one whose run ended before its first
        checkpoint may. RunError if the folder contains a run, or something else."""
        if self.checkpoints():
            raise RunError(
                f"{self.path} already holds a run: resume it, or choose another folder",
                options=("resume", "output"),
            )
        problem = ""
        if self.config_file.exists():
            if not self._config_values().keys() >= _EVERY_CONFIG_HAS:
                problem = "a config.yaml that is not a run's"
        elif self.log_file.exists():
            problem = "a log.jsonl that is not a run's"
        elif self.path.is_dir():
            names = {path.name for path in self.path.iterdir() if path.name[0] != "."}
            if foreign := sorted(names - _LEFT_BEHIND):
                problem = f"something else ({listed(foreign)})"
        if problem:
            why = f"{self.path} holds {problem}: choose another folder"
            raise RunError(why, options=("output",))

    def start(self, config: RunConfig) -> None:
        """Make the folder a new run. RunError if it contains a run, or cannot be written."""
        self.require_new()
        with self._writing():
            self.log_file.unlink(missing_ok=True)
        write_text(self.config_file, write_yaml(config))

    @property
    def method(self) -> str:
        """The name of the run's method. RunError if the folder is not a run."""
        values = self.read_config(parse_yaml)
        if isinstance(values, dict) and isinstance(name := values.get("method"), str):
            return name
        raise RunError(
            f"{self.path} is not a run: its config.yaml names no method; fix the file or retrain"
        )

    def read_config(self, read: ReadConfig[T]) -> T:
        """The run's configuration, by the method's parser. RunError if the folder is not a run, or
        its configuration cannot be used."""
        self._require_config()
        try:
            return read(read_text(self.config_file), str(self.config_file))
        except ConfigError as error:
            raise RunError(f"{error}; fix the file or retrain") from error
        except (OSError, UnicodeDecodeError) as error:
            raise RunError(
                f"{self.path} is not a run: its config.yaml cannot be read; name a folder that "
                f"`mrgs train` wrote"
            ) from error

    def read_whole_config(self, read: ReadConfig[C]) -> C:
        """``read_config`` of a run with a checkpoint, whose config.yaml names every setting.
        MrgsWarning if it lacks some, for which the defaults are used: it may have been cut off."""
        self.newest_checkpoint()
        config = self.read_config(read)
        have = flat(self._config_values())
        missing = [name for name in flat(asdict(cast(Any, config))) if name not in have]
        if missing:
            warn_user(
                f"{self.config_file} lacks {listed(missing)}, for which the defaults are used: "
                f"restore it if it was cut off"
            )
        return config

    def _require_config(self) -> None:
        if self.config_file.is_file():
            return
        inside = []
        with suppress(OSError):
            folders = sorted(path.parent for path in self.path.glob("*/config.yaml"))
            inside = [str(folder) for folder in folders if RunFolder(folder).checkpoints()]
        problem = "it has no config.yaml; name a folder that `mrgs train` wrote"
        if inside:  # as where `mrgs run` keeps its results
            problem = f"it contains {listed(inside)}: give that folder"
        raise RunError(f"{self.path} is not a run: {problem}")

    def _config_values(self) -> dict[str, Any]:
        """The outermost entries of config.yaml; empty if it contains something else."""
        values = None
        with suppress(RunError):
            values = self.read_config(parse_yaml)
        return values if isinstance(values, dict) else {}

    @property
    def custom_parts(self) -> list[str]:
        """What the run was trained with besides its configuration, which comments of config.yaml
        name; empty without that file."""
        with suppress(RunError):
            lines = self.read_config(lambda text, _: text.splitlines())
            return [line.removeprefix(_CUSTOM) for line in lines if line.startswith(_CUSTOM)]
        return []

    def note_custom_parts(self, parts: Iterable[str]) -> None:
        """Add those to config.yaml that it does not name yet. RunError if it cannot be written."""
        lines = [" ".join(part.split())[:_LONGEST_CUSTOM] for part in parts]
        known = self.custom_parts if lines else []
        if new := [line for line in lines if line not in known]:
            text = self.read_config(lambda text, _: text.rstrip("\n"))
            write_text(self.config_file, "\n".join([text, *(_CUSTOM + line for line in new), ""]))

    def append_log(self, entry: dict[str, Any], pictures: Pictures | None = None) -> None:
        """Add a line to the log, null for numbers that are not finite, and pictures to the log for
        TensorBoard, if one is written; RunError if the log cannot be written."""
        finite = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in entry.items()
        }
        with self._writing(), self.log_file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(finite, allow_nan=False) + "\n")
        for name, value in finite.items():
            if self._tensorboard and name != "step" and isinstance(value, int | float):
                grouped = re.sub("^(loss|eval)_", r"\1/", name)
                self._tensorboard.add_scalar(grouped, value, finite["step"])
        for name, picture in (pictures or {}).items():
            if self._tensorboard:
                self._tensorboard.add_image(name, picture, finite["step"], dataformats="HWC")

    @contextmanager
    def tensorboard_log(self, step: int) -> Iterator[None]:
        """Within this block, write the numbers of the log as TensorBoard scalars, too; it hides
        what an earlier part of the training wrote after the step that this one continues from.
        ConfigError if TensorBoard is not installed."""
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ModuleNotFoundError:
            raise ConfigError(
                "TensorBoard is not installed: run `pip install 'mrgs[tensorboard]'`",
                options=("tensorboard",),
            ) from None
        with SummaryWriter(str(self.path / TENSORBOARD), purge_step=step + 1) as writer:
            self._tensorboard = writer
            try:
                yield
            finally:
                self._tensorboard = None

    def cut_log(self, step: int) -> None:
        """Drop the lines after a step, which a resumed run writes again."""
        if not self.log_file.exists():
            return
        with open_regular(self.log_file) as file:
            lines = (line.decode("utf-8", "replace").rstrip("\r\n") for line in file)
            kept = [line for line in lines if _step_of(line) <= step]
        write_text(self.log_file, "".join(line + "\n" for line in kept))

    def locked(self) -> AbstractContextManager[None]:
        """Around what no other process may do in the folder meanwhile. FolderInUseError if another
        process uses it, WriteError if the folder cannot be made."""
        in_use = FolderInUseError(
            f"{self.path} is in use by another run: wait for it, or choose another folder",
            options=("output",),
        )
        return locked(self.path / LOCK, in_use, options=("output",))

    @property
    def is_locked(self) -> bool:
        """Whether a process uses the folder. One that cannot be written is not used."""
        if not (self.path / LOCK).exists():
            return False
        try:
            with self.locked():
                return False
        except RunError as error:
            return isinstance(error, FolderInUseError)

    @contextmanager
    def training(self, config: RunConfig, resume: bool) -> Iterator[None]:
        """Within this block a run in the folder is trained: a new one, unless ``resume``; one that
        ends before its first checkpoint leaves nothing. RunError if another process uses the
        folder, or it cannot be used."""
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
            except (SceneError, KeyboardInterrupt):  # photos are decoded when they are first used
                if not self.checkpoints():
                    self.discard()
                raise

    def discard(self) -> None:
        """Remove a run without a checkpoint, and the folder if that is empty; under the lock."""
        for name in ("config.yaml", "log.jsonl"):
            (self.path / name).unlink(missing_ok=True)
        with suppress(OSError):  # something else is in it
            (self.path / LOCK).unlink(missing_ok=True)
            self.path.rmdir()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn what the file system refuses into an error with a remedy."""
        try:
            yield
        except OSError as error:
            raise write_error(self.path, error, options=("output",)) from error


def step_named(checkpoint: Path) -> int | None:
    """The step in a checkpoint's name; None if it is not named like one."""
    found = re.fullmatch(r"step_([0-9]{1,18})\.safetensors", checkpoint.name)
    return None if found is None else int(found[1])


def _step_of(line: str) -> int:
    """The step of a log line; a torn last line counts as after everything."""
    try:
        return int(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return 2**62
