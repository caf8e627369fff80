"""The newest checkpoint of a run that is good."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from mrgs.errors import DamagedCheckpointError, RunError, warn_user
from mrgs.training.run_folder import RunFolder

T = TypeVar("T")


def load_newest(folder: RunFolder, load: Callable[[Path], T], *, set_aside: bool = False) -> T:
    """Load a run's newest checkpoint, or an older one if that is damaged.

    Args:
        folder: of the run.
        load: reads a checkpoint; raises DamagedCheckpointError for one that is damaged.
        set_aside: rename damaged checkpoints, because the run is going to write newer ones.

    Warns:
        MrgsWarning: an older one is used.

    Raises:
        RunError: there is no checkpoint, all are damaged, or the newest that is not cannot be used.
    """
    folder.newest_checkpoint()
    damaged: list[DamagedCheckpointError] = []
    for path in reversed(folder.checkpoints()):
        try:
            found = load(path)
        except DamagedCheckpointError as error:
            damaged.append(error)
            continue
        for one in damaged:
            warn_user(_older_is_used(folder, one, path, set_aside))
        return found
    raise RunError(
        f"{folder.path} has no checkpoint that is whole ({damaged[0].reason}): restore one from a "
        f"copy, or retrain into another folder"
    )


def _older_is_used(
    folder: RunFolder, error: DamagedCheckpointError, older: Path, set_aside: bool
) -> str:
    text = f"{error.path} is not a whole checkpoint ({error.reason}); {older.name} is used instead"
    return f"{text}; it is kept as {folder.set_aside(error.path).name}" if set_aside else text
