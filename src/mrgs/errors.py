"""Errors for users. Every message names the file or value at fault and the remedy."""

from __future__ import annotations

import contextlib
import os
import sys
import unicodedata
import warnings
from pathlib import Path

_INSIDE = (str(Path(__file__).parent) + os.sep, contextlib.__file__)
"""Files of this package, and what is between a ``with`` and the block that it opens."""

LONGEST_LINE = 10_000
"""Characters that are shown of a longer text; a path has 4,096 at most."""


def printable(text: str) -> str:
    """The text on one line, with escapes for what is not printable, such as line ends, colours of a
    terminal or directions of reading; without the middle beyond ``LONGEST_LINE`` characters."""

    def shown(each: str) -> str:
        # Joiners are parts of words of many languages, and of emoji.
        if each.isprintable() or each in "\u200c\u200d" or unicodedata.category(each) == "Zs":
            return each
        return each.encode("unicode_escape").decode().replace("\\x", "\\u00")

    if len(text) > LONGEST_LINE:  # a name in a file may have megabytes
        text = f"{text[: LONGEST_LINE // 2]} … {text[-LONGEST_LINE // 2 :]}"
    return text if text.isprintable() else "".join(map(shown, text))


class MrgsError(Exception):
    """An error that the user can fix; the command line prints it as one line and exits with code 2.

    Attributes:
        options: parameters of the Python API that are at fault or that help, such as
            ``thermal_fov_deg``; the command line shows its flags for them.
    """

    def __init__(self, message: str, *, options: tuple[str, ...] = ()) -> None:
        self.message = printable(message)
        super().__init__(self.message)
        self.options = options


class SceneError(MrgsError):
    """A scene folder, or a file in it, cannot be used."""


def scene_error(file: Path | str, problem: str, *, options: tuple[str, ...] = ()) -> SceneError:
    """An error of one line that names the file first; for ``options`` see ``MrgsError``."""
    return SceneError(f"{file}: {problem}".replace("\n", " "), options=options)


class ToolError(SceneError):
    """A program that reads a file is missing or has failed; the next call may find it in order."""


class RunError(MrgsError):
    """A run folder, or a checkpoint in it, cannot be used."""


class FolderInUseError(RunError):
    """Another process trains in the run folder."""


class WriteError(RunError):
    """A file cannot be written or removed: no room, or no permission."""


class DamagedCheckpointError(RunError):
    """A checkpoint is damaged, or holds values that are not finite; an older one may be good."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(
            f"{path} is not a whole checkpoint ({reason}): restore a copy, or use an older one"
        )
        self.path = path
        self.reason = reason

    def __reduce__(self) -> tuple[type[DamagedCheckpointError], tuple[Path, str]]:
        """Processes hand errors over by what they are made from."""
        return type(self), (self.path, self.reason)


class ConfigError(MrgsError):
    """An option or a configuration value is not allowed."""


class DeviceError(MrgsError):
    """The GPU that was asked for cannot be used."""


class TrainingError(MrgsError):
    """Training had to stop; the last good checkpoint is kept."""


class NotFiniteError(TrainingError):
    """The model holds a NaN or an infinity, and was not saved."""


class MrgsWarning(UserWarning):
    """Something was repaired or skipped; the result is usable, the message says what changed."""


class KernelWarning(MrgsWarning):
    """A kernel does not compute what its plain definition says, so the definition runs."""


def warn_user(text: str, category: type[MrgsWarning] = MrgsWarning) -> None:
    """Warn of something in a call of this package; the warning points at the line of that call."""
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_INSIDE):
        frame, level = frame.f_back, level + 1
    warnings.warn(printable(text), category, stacklevel=level)
