"""Runs ``mrgs.prepare.colmap`` in a process of its own.

From version 4.1 on pycolmap breaks zlib in the process that imports it, and it can crash any
process; its memory is freed when the process ends.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Sequence
from pathlib import Path

from mrgs.errors import ConfigError, SceneError
from mrgs.prepare.contract import Progress
from mrgs.system.atomic import write_error
from mrgs.system.child import OUT_OF_MEMORY, Child

CHILD = ("-m", "mrgs.prepare.colmap")
LOG_FILE = "log.txt"
LEAST_VERSION = 4


def run_colmap(folder: Path, progress: Progress, program: Sequence[str] = CHILD) -> None:
    """Complete the job in ``folder``; see ``mrgs.prepare.colmap``.

    Args:
        folder: holds the job; a log of the process is written there.
        progress: called with the process's steps.
        program: arguments of the Python interpreter that start the process.

    Raises:
        SceneError: the process failed, crashed, or was killed.
        RunError: the folder cannot be written.
    """
    log = folder / LOG_FILE
    try:
        child = Child(program, str(folder.resolve()), log)
    except OSError as error:
        raise write_error(log, error) from None
    try:
        for message in child.messages():
            progress(message["step"], message["done"], message["of"])
    finally:
        child.close()
    if reason := child.failure():
        raise SceneError(f"finding the poses failed: {reason}{_remedy(child, reason)}; see {log}")


def _remedy(child: Child, reason: str) -> str:
    if child.end:  # the message says it all
        return ""
    if reason == OUT_OF_MEMORY:
        return "; close other programs or use smaller photos, and call again to continue"
    return "; call again to continue"


def installed_version() -> str | None:
    """pycolmap's version; None if it is not installed."""
    try:
        return importlib.metadata.version("pycolmap")
    except importlib.metadata.PackageNotFoundError:
        return None


def check_version(version: str | None) -> None:
    """Check pycolmap's version.

    Raises:
        ConfigError: it is not installed, or too old.
    """
    install = 'pip install "mrgs[sfm]"'
    if version is None:
        raise ConfigError(
            f"finding the poses needs pycolmap: {install}, or give poses that you have"
        )
    if int(version.partition(".")[0]) < LEAST_VERSION:
        raise ConfigError(f"pycolmap {version} is too old: {install}")
