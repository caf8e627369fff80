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


def test_a_pass_that_was_cut_short_forgets_nothing(photo, tmp_path, read):
    other = tmp_path / "b.jpg"
    other.write_bytes(b"b")
    contents = Contents(tmp_path / "known.json")
    for path in (photo, other):
        contents.digest(path)
    contents.save()
    photo.write_bytes(b"changed")
    contents = Contents(tmp_path / "known.json")
    contents.digest(photo)
    contents.save()
    assert read == ["a.jpg", "b.jpg", "a.jpg"]
    contents = Contents(tmp_path / "known.json")
    assert [contents.digest(path) for path in (photo, other)] == [sha(b"changed"), sha(b"b")]
    assert read == ["a.jpg", "b.jpg", "a.jpg"]


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


def test_where_the_ctime_shows_no_change_files_are_read_by_each_call(
    photo, tmp_path, read, monkeypatch
):
    monkeypatch.setattr(contents_module, "_CTIME_SHOWS_CHANGES", False)
    for _ in range(2):
        contents = Contents(tmp_path / "known.json")
        assert [contents.digest(photo) for _ in range(2)] == [sha(b"abc")] * 2
        contents.save()
    assert read == ["a.jpg", "a.jpg"]


@pytest.mark.parametrize("known", ["", "[]", '{"a": 1}', '{"a": [1, 2, 3]}', "[" * 100_000])
def test_a_damaged_memory_is_empty(photo, tmp_path, known, read):
    (tmp_path / "known.json").write_text(known)
    contents = Contents(tmp_path / "known.json")
    assert contents.digest(photo) == sha(b"abc")
    contents.save()
    assert read == ["a.jpg"]
    assert Contents(tmp_path / "known.json").digest(photo) == sha(b"abc")
    assert read == ["a.jpg"]
