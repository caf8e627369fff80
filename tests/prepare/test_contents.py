"""Digests that are remembered."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import pytest

from mrgs.prepare.cache import digest
from mrgs.prepare.contents import Contents


class Reader:
    """Reads files, and remembers their names in order."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def __call__(self, path: Path) -> str:
        self.names.append(path.name)
        return digest(path)


@pytest.fixture
def read() -> Reader:
    return Reader()


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"abc")
    return path


def sha(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def test_a_file_is_read_once_until_it_changes(photo, tmp_path, read):
    for _ in range(2):
        contents = Contents(tmp_path / "known.json", read)
        assert [contents.digest(photo) for _ in range(2)] == [sha(b"abc")] * 2
        contents.save()
    assert read.names == ["a.jpg"]
    status = photo.stat()
    photo.write_bytes(b"xyz")
    os.utime(photo, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert Contents(tmp_path / "known.json", read).digest(photo) == sha(b"xyz")


def test_a_file_that_cannot_be_read_is_not_remembered(photo, tmp_path):
    answers = iter(["", sha(b"abc")])
    contents = Contents(tmp_path / "known.json", lambda path: next(answers))
    assert contents.digest(tmp_path / "none") == ""
    assert contents.digest(photo) == ""
    assert contents.digest(photo) == sha(b"abc")


def test_a_pass_that_was_cut_short_forgets_nothing(photo, tmp_path, read):
    other = tmp_path / "b.jpg"
    other.write_bytes(b"b")
    contents = Contents(tmp_path / "known.json", read)
    for path in (photo, other):
        contents.digest(path)
    contents.save()
    photo.write_bytes(b"changed")
    contents = Contents(tmp_path / "known.json", read)
    contents.digest(photo)
    contents.save()
    assert read.names == ["a.jpg", "b.jpg", "a.jpg"]
    contents = Contents(tmp_path / "known.json", read)
    assert [contents.digest(path) for path in (photo, other)] == [sha(b"changed"), sha(b"b")]
    assert read.names == ["a.jpg", "b.jpg", "a.jpg"]


def test_after_a_full_pass_other_files_are_forgotten(photo, tmp_path):
    (tmp_path / "b.jpg").write_bytes(b"b")
    contents = Contents(tmp_path / "known.json")
    for name in ("a.jpg", "b.jpg"):
        contents.digest(tmp_path / name)
    contents.save()
    contents = Contents(tmp_path / "known.json")
    contents.digest(photo)
    contents.forget_others()
    contents.save()
    assert list(json.loads((tmp_path / "known.json").read_text())) == [str(photo)]


def test_where_the_ctime_shows_no_change_files_are_read_by_each_call(photo, tmp_path, read):
    for _ in range(2):
        contents = Contents(tmp_path / "known.json", read, kept=False)
        assert [contents.digest(photo) for _ in range(2)] == [sha(b"abc")] * 2
        contents.save()
    assert read.names == ["a.jpg", "a.jpg"]


@pytest.mark.parametrize("known", ["", "[]", '{"a": 1}', '{"a": [1, 2, 3]}', "[" * 100_000])
def test_a_damaged_memory_is_empty(photo, tmp_path, known, read):
    (tmp_path / "known.json").write_text(known)
    contents = Contents(tmp_path / "known.json", read)
    assert contents.digest(photo) == sha(b"abc")
    contents.save()
    assert read.names == ["a.jpg"]
    assert Contents(tmp_path / "known.json", read).digest(photo) == sha(b"abc")
    assert read.names == ["a.jpg"]
