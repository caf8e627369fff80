"""Runs ``mrgs.prepare.colmap`` as a process of its own.

From version 4.1 on pycolmap breaks zlib in the process that imports it, and it can take any process
down; its memory is given back when it ends.
"""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path
from typing import Any, TextIO

from mrgs.errors import ConfigError, RunError, SceneError
from mrgs.prepare.contract import Progress
from mrgs.system.isolation import CHILD_FOLDER, child_environment

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
    with _opened(log) as errors:
        process = subprocess.Popen(
            [sys.executable, *CHILD, str(folder.resolve())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            encoding="utf-8",
            errors="replace",
            # Threads that spin while they wait would starve those that work.
            env=child_environment(OMP_WAIT_POLICY="PASSIVE"),
            cwd=CHILD_FOLDER,
            start_new_session=True,  # Ctrl-C is for this process alone
        )
    try:
        end = _listen(process, progress)
        status = process.wait()
    finally:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            pipe.close()
    if status != 0 or end.get("end") != "done":
        raise SceneError(f"finding the poses failed: {_reason(status, end)}; see {log}")


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


def _opened(log: Path) -> TextIO:
    try:
        return log.open("w", encoding="utf-8")
    except OSError as error:
        raise RunError(
            f"{log} cannot be written ({error.strerror}); free the place or choose another"
        ) from None


def _listen(process: subprocess.Popen[str], progress: Progress) -> dict[str, Any]:
    """Forward the progress; returns the last message."""
    assert process.stdout is not None
    end: dict[str, Any] = {}
    for line in process.stdout:
        try:
            message = json.loads(line)
        except ValueError:  # a library that prints
            continue
        if isinstance(message, dict) and "step" in message:
            progress(message["step"], message["done"], message["of"])
        elif isinstance(message, dict) and "end" in message:
            end = message
    return end


def _reason(status: int, end: dict[str, Any]) -> str:
    if end.get("end") == "error":
        return str(end["message"])
    if status == -9:
        return (
            "the system ended the process (signal 9), most likely for want of memory; close other "
            "programs or use "
            "smaller photos, and call again to continue"
        )
    return f"the process ended with status {status}; call again to continue"
