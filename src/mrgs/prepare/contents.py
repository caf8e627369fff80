"""Digests of files' contents, remembered from call to call: a file is read again only where its
size or one of its times has changed. On Windows nothing is remembered from call to call."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

from mrgs.prepare.cache import Stamp, digest, stamp_of
from mrgs.system.atomic import write_text

_CTIME_SHOWS_CHANGES = os.name != "nt"


class Contents:
    """Digests of files, remembered in a JSON file.

    Args:
        file: the JSON file; where it is missing or damaged, nothing is remembered. On Windows it
            is not used.
        read: gives the digest of a file's content, in place of ``cache.digest``.
        kept: whether digests are remembered from call to call.
    """

    def __init__(
        self,
        file: Path,
        read: Callable[[Path], str] | None = None,
        kept: bool = _CTIME_SHOWS_CHANGES,
    ) -> None:
        self._file, self._read, self._kept = file, read or digest, kept
        self._saved = _read(file) if kept else {}
        self._known = dict(self._saved)
        self._asked: set[str] = set()

    def digest(self, path: Path) -> str:
        """SHA-256 of a file's content; empty if it cannot be read, which is not remembered."""
        name = str(path)
        try:
            stamp = stamp_of(path)
        except OSError:
            return ""
        known = self._known.get(name)
        if known is None or known[0] != stamp:
            known = stamp, self._read(path)
        if known[1]:
            self._known[name] = known
            self._asked.add(name)
        return known[1]

    def forget_others(self) -> None:
        """Forget all files that were not asked for; call it after a pass over all files."""
        self._known = {name: self._known[name] for name in self._known if name in self._asked}

    def save(self) -> None:
        """Remember the files that were asked for, now or in earlier calls.

        Raises:
            RunError: the file cannot be written.
        """
        if self._kept and self._known != self._saved:
            self._saved = dict(self._known)
            lines = {name: [*stamp, found] for name, (stamp, found) in self._known.items()}
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
