"""Where the code of this package was called from."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from pathlib import Path

from mrgs.errors import MrgsWarning

_PACKAGE = str(Path(__file__).parents[1]) + os.sep
_BETWEEN = contextlib.__file__
"""Stands between a ``with`` and the block that it opens."""


def warn(text: str, category: type[MrgsWarning] = MrgsWarning) -> None:
    """Warn of something that concerns the user's call of this package: the warning points at it.

    Warns:
        MrgsWarning: the text, in this category.
    """
    warnings.warn(text, category, stacklevel=_users_level())


def _users_level() -> int:
    """The ``stacklevel`` with which the calling function's warning points at the line outside of
    this package from which it was called; at the outermost one where there is none."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and _is_own(frame.f_code.co_filename):
        frame, level = frame.f_back, level + 1
    return level


def _is_own(file: str) -> bool:
    return file.startswith(_PACKAGE) or file == _BETWEEN
