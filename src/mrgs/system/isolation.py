"""How a Python process is started so that it imports nothing from the user's folders.

``python -m`` puts the current folder first on ``sys.path``: a ``json.py`` among downloaded photos
would be run.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

CHILD_FOLDER = Path(sys.prefix)
"""Where such a process runs: Python's own folder, for Python 3.10 does not know PYTHONSAFEPATH."""


def child_environment(**changes: str) -> dict[str, str]:
    """The environment of such a process: this one's, with changes; PYTHONPATH means the same
    folders as here."""
    environment = {**os.environ, "PYTHONSAFEPATH": "1", **changes}
    # An empty entry is the current folder, and most often there by mistake.
    entries = [
        os.path.abspath(entry)
        for entry in environment.pop("PYTHONPATH", "").split(os.pathsep)
        if entry
    ]
    if entries:
        environment["PYTHONPATH"] = os.pathsep.join(entries)
    return environment
