"""Which stages of a pipeline are done, and with which inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from pathlib import Path

import msgspec

from mrgs.data.files import visible_files
from mrgs.data.kept import Digests, stamp_of
from mrgs.errors import RunError
from mrgs.system.atomic import write_text

LEDGER = "pipeline.json"
CONTENTS = "contents.json"
"""File of the digests of the scene's files."""


class _Entry(msgspec.Struct, omit_defaults=True):
    """A stage that was begun, and the sizes of its files if it was finished."""

    made_from: str
    files: dict[str, int | None] | None = None


class Ledger:
    """The finished stages, in a JSON file; an unreadable entry counts as not done."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._file = folder, folder / LEDGER
        self._digests = Digests(folder / CONTENTS)
        self._stages: dict[str, _Entry] = {}
        with suppress(OSError, msgspec.MsgspecError, RecursionError):
            self._stages = msgspec.json.decode(self._file.read_bytes(), type=dict[str, _Entry])

    def open(self) -> None:
        """Make the file if there is none: it marks the folder as a pipeline's. RunError if it
        cannot be written."""
        if not self._file.is_file():
            self._write()

    def is_done(self, stage: str, made_from: Callable[[], str]) -> bool:
        """Whether a stage was finished with these inputs, and its files are as it left them."""
        if not self.is_begun(stage, made_from) or (files := self._stages[stage].files) is None:
            return False
        return all(_size(self._folder / name) == size for name, size in files.items())

    def is_begun(self, stage: str, made_from: Callable[[], str]) -> bool:
        """Whether a stage was begun, or finished, with the inputs as they are now, of which
        ``made_from`` gives the digest; they are read only if it was ever begun."""
        return stage in self._stages and self._stages[stage].made_from == made_from()

    def begin(self, stage: str, made_from: str) -> None:
        """Note that a stage begins; RunError if the file cannot be written."""
        self._stages[stage] = _Entry(made_from)
        self._write()

    def finish(self, stage: str, made_from: str, files: Sequence[Path]) -> None:
        """Note that a stage is finished, and the files that it made; errors as for ``begin``."""
        sizes = {path.relative_to(self._folder).as_posix(): _size(path) for path in files}
        self._stages[stage] = _Entry(made_from, sizes)
        self._write()

    def contents_of(self, folder: Path, without: Sequence[str] = ()) -> list[tuple[str, str]]:
        """Names and SHA-256 of all visible files below a folder, sorted. Only those that changed
        since the last call, also of another process, are read (on Windows: of this process). Files
        and folders whose names match a pattern of ``without`` do not count. RunError if the digests
        cannot be written."""
        found = []
        try:
            for path in sorted(filter(Path.is_file, visible_files(folder))):
                own = path.relative_to(folder)
                if not any(fnmatchcase(part, each) for each in without for part in own.parts):
                    found.append((own.as_posix(), self._digests.of(path)))
        except BaseException:  # Ctrl-C: the next call reads the others only
            with suppress(RunError):
                self._digests.save()
            raise
        self._digests.save(forget_others=True)
        return found

    def _write(self) -> None:
        content = msgspec.json.format(msgspec.json.encode(self._stages), indent=1)
        write_text(self._file, content.decode())


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except (OSError, ValueError):
        return None


def file_stamp(path: Path, root: Path) -> tuple[str, int, int]:
    """Path, size and mtime of a file below a folder, which only this program writes. A copy that
    keeps its mtime is the same file."""
    size, mtime, _ = stamp_of(path)
    return path.relative_to(root).as_posix(), size, mtime
