"""Digests that are remembered."""

from __future__ import annotations

import hashlib
import json
import os

import pytest

from mrgs.prepare import contents as contents_module
from mrgs.prepare.contents import Contents


@pytest.fixture
def read(monkeypatch):
    """The names of the files that are read, in order."""
    names = []
    original = contents_module.digest
    monkeypatch.setattr(
        contents_module, "digest", lambda path: names.append(path.name) or original(path)
    )
    return names


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"abc")
    return path


def sha(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def test_a_file_is_read_once_until_it_changes(photo, tmp_path, read):
    for _ in range(2):
        contents = Contents(tmp_path / "known.json")
        assert [contents.digest(photo) for _ in range(2)] == [sha(b"abc")] * 2
        contents.save()
    assert read == ["a.jpg"]
    status = photo.stat()
    photo.write_bytes(b"xyz")
    os.utime(photo, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert Contents(tmp_path / "known.json").digest(photo) == sha(b"xyz")


def test_a_file_that_cannot_be_read_is_not_remembered(photo, tmp_path, monkeypatch):
    contents = Contents(tmp_path / "known.json")
    assert contents.digest(tmp_path / "none") == ""
    with monkeypatch.context() as patch:
        patch.setattr(contents_module, "digest", lambda path: "")
        assert contents.digest(photo) == ""
    assert contents.digest(photo) == sha(b"abc")


def test_only_files_that_were_asked_for_are_kept(photo, tmp_path):
    (tmp_path / "b.jpg").write_bytes(b"b")
    contents = Contents(tmp_path / "known.json")
    for name in ("a.jpg", "b.jpg"):
        contents.digest(tmp_path / name)
    contents.save()
    contents = Contents(tmp_path / "known.json")
    contents.digest(photo)
    contents.save()
    assert list(json.loads((tmp_path / "known.json").read_text())) == [str(photo)]


@pytest.mark.parametrize("known", ["", "[]", '{"a": 1}', '{"a": [1, 2, 3]}', "[" * 100_000])
def test_a_damaged_memory_is_empty(photo, tmp_path, known, read):
    (tmp_path / "known.json").write_text(known)
    contents = Contents(tmp_path / "known.json")
    assert contents.digest(photo) == sha(b"abc")
    contents.save()
    assert read == ["a.jpg"]
    assert Contents(tmp_path / "known.json").digest(photo) == sha(b"abc")
    assert read == ["a.jpg"]
