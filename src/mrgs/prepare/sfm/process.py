"""Runs ``mrgs.prepare.colmap`` as a process of its own.

From version 4.1 on pycolmap breaks zlib in the process that imports it, and it can take any process
down; its memory is given back when it ends.
"""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

from mrgs.errors import ConfigError, RunError, SceneError
from mrgs.prepare.contract import Progress
from mrgs.system.child import OUT_OF_MEMORY, Child

CHILD = ("-m", "mrgs.prepare.colmap")
LOG_FILE = "log.txt"
LEAST_VERSION = 4


def run_colmap(folder: Path, progress: Progress) -> None:
    """Do what is left of the job in ``folder``; see ``mrgs.prepare.colmap``.

    Raises:
        ConfigError: pycolmap is not installed, or too old.
        SceneError: it failed, crashed, or was killed.
        RunError: the folder cannot be written.
    """
    _check_installed()
    log = folder / LOG_FILE
    try:
        child = Child(CHILD, str(folder.resolve()), log)
    except OSError as error:
        raise RunError(
            f"{log} cannot be written ({error.strerror}); free the place or choose another"
        ) from None
    try:
        for message in child.messages():
            progress(message["step"], message["done"], message["of"])
    finally:
        child.close()
    if reason := child.failure():
        raise SceneError(f"finding the poses failed: {reason}{_remedy(child, reason)}; see {log}")


def _remedy(child: Child, reason: str) -> str:
    if child.end:  # an error that it understands
        return ""
    if reason == OUT_OF_MEMORY:
        return "; close other programs or use smaller photos, and call again to continue"
    return "; call again to continue"


def _check_installed() -> None:
    install = 'pip install "mrgs[sfm]"'
    try:
        version = importlib.metadata.version("pycolmap")
    except importlib.metadata.PackageNotFoundError:
        raise ConfigError(
            f"finding the poses needs pycolmap: {install}, or give poses that you have"
        ) from None
    if int(version.partition(".")[0]) < LEAST_VERSION:
        raise ConfigError(f"pycolmap {version} is too old: {install}")
