"""Digests of files' contents, remembered from call to call: a file is read again only where its
size or one of its times has changed."""

from __future__ import annotations

import json
from pathlib import Path

from mrgs.prepare.cache import digest
from mrgs.system.atomic import write_text

Stamp = tuple[int, int, int]
"""Size in bytes, mtime and ctime (ns). An export may give a file its old size and mtime; the
ctime is the system's own."""


def stamp_of(path: Path) -> Stamp:
    """The stamp of a file.

    Raises:
        OSError: there is none, or it cannot be looked at.
    """
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


class Contents:
    """Digests of files, remembered in a JSON file.

    Args:
        file: the JSON file; where it is missing or damaged, nothing is remembered.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._known = _read(file)
        self._asked: dict[str, tuple[Stamp, str]] = {}

    def digest(self, path: Path) -> str:
        """SHA-256 of a file's content; empty if it cannot be read, which is not remembered."""
        name = str(path)
        try:
            stamp = stamp_of(path)
        except OSError:
            return ""
        known = self._asked.get(name) or self._known.get(name)
        if known is None or known[0] != stamp:
            known = stamp, digest(path)
        if known[1]:
            self._asked[name] = known
        return known[1]

    def save(self) -> None:
        """Remember the files that were asked for, and no others.

        Raises:
            RunError: the file cannot be written.
        """
        if self._asked != self._known:
            self._known = dict(self._asked)
            lines = {name: [*stamp, found] for name, (stamp, found) in self._asked.items()}
            write_text(self._file, json.dumps(lines))


def _read(file: Path) -> dict[str, tuple[Stamp, str]]:
    try:
        lines = json.loads(file.read_text(encoding="utf-8"))
        return {
            name: ((int(size), int(mtime), int(ctime)), str(found))
            for name, (size, mtime, ctime, found) in lines.items()
        }
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}
