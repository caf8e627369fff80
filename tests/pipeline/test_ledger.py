"""Which stages are done."""

from __future__ import annotations

import json
import os

import pytest

from mrgs.data import kept
from mrgs.pipeline.stages import LEDGER, Ledger


@pytest.fixture
def done(tmp_path):
    """A ledger with one stage that made one file."""
    (tmp_path / "a.txt").write_text("abc")
    ledger = Ledger(tmp_path)
    ledger.finish("train", "photos", [tmp_path / "a.txt"])
    return ledger


def test_what_is_done_is_known_to_the_next_process(done, tmp_path):
    for ledger in (done, Ledger(tmp_path)):
        assert ledger.is_done("train", lambda: "photos")
        assert ledger.is_begun("train", lambda: "photos")
        assert not ledger.is_done("train", lambda: "other photos")
        assert not ledger.is_begun("train", lambda: "other photos")
        assert not ledger.is_done("score", lambda: "photos")


@pytest.mark.parametrize("content", [None, "abcd"])
def test_a_file_that_is_gone_or_was_changed_must_be_made_again(content, done, tmp_path):
    if content is None:
        (tmp_path / "a.txt").unlink()
    else:
        (tmp_path / "a.txt").write_text(content)
    assert not done.is_done("train", lambda: "photos")
    assert done.is_begun("train", lambda: "photos")


def test_what_is_begun_is_not_done(done, tmp_path):
    done.begin("train", "new photos")
    ledger = Ledger(tmp_path)
    assert ledger.is_begun("train", lambda: "new photos")
    assert not ledger.is_done("train", lambda: "new photos")
    assert not ledger.is_done("train", lambda: "photos")


@pytest.mark.parametrize(
    "content",
    [
        "", "{", "[]", '{"train": 3}', '{"train": {"made_from": "photos", "files": 1}}',
        '{"train": {"made_from": "photos", "files": {"a\\u0000": 3}}}', "[" * 100_000,
    ],
)  # fmt: skip
def test_a_damaged_ledger_holds_nothing(content, tmp_path):
    (tmp_path / LEDGER).write_text(content)
    assert not Ledger(tmp_path).is_done("train", lambda: "photos")


def test_opening_marks_the_folder_and_keeps_what_is_there(done, tmp_path):
    before = (tmp_path / LEDGER).read_text()
    done.open()
    assert (tmp_path / LEDGER).read_text() == before
    (tmp_path / "new").mkdir()
    Ledger(tmp_path / "new").open()
    assert json.loads((tmp_path / "new" / LEDGER).read_text()) == {}


def test_contents_see_changes_and_leave_out_what_does_not_count(tmp_path):
    folder = tmp_path / "scene"
    for name in ("a.txt", "prepare/x.bin", "check.html", "images/prepare.png"):
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_text(name)

    def held() -> list[tuple[str, str]]:
        return Ledger(tmp_path).contents_of(folder, without=("prepare", "*.html"))

    before, status = held(), (folder / "a.txt").stat()
    assert [name for name, _ in before] == ["a.txt", "images/prepare.png"]
    (folder / "check.html").write_text("other")
    os.utime(folder / "a.txt", (1, 1))
    assert held() == before
    (folder / "a.txt").write_text("b.txt")
    os.utime(folder / "a.txt", ns=(status.st_atime_ns, status.st_mtime_ns))
    assert held() != before


def test_reading_the_contents_may_be_cut_short(tmp_path, monkeypatch):
    folder, read = tmp_path / "scene", []
    folder.mkdir()
    for name in "abc":
        (folder / name).write_text(name)
    original = kept.digest

    def digest(path):
        if path.name == "b" and not read.count("b"):
            read.append("b")
            raise KeyboardInterrupt
        read.append(path.name)
        return original(path)

    monkeypatch.setattr(kept, "digest", digest)
    with pytest.raises(KeyboardInterrupt):
        Ledger(tmp_path).contents_of(folder)
    assert len(Ledger(tmp_path).contents_of(folder)) == 3
    assert read == ["a", "b", "b", "c"]


def test_the_inputs_of_a_stage_that_was_never_begun_are_not_read(done):
    def read() -> str:
        raise AssertionError("they take long")

    assert not done.is_begun("score", read)
