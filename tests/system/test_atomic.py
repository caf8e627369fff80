from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from mrgs.errors import RunError
from mrgs.system import atomic
from mrgs.system.atomic import (
    TEMPORARY,
    remove,
    remove_abandoned,
    replacing,
    write_error,
    write_text,
)


def test_a_whole_file_appears_in_a_new_folder(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "file.txt"
    with replacing(path) as temporary:
        temporary.write_text("whole")
        assert not path.exists()
        assert temporary.suffix == ".txt"
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]


def test_an_error_keeps_the_old_file_and_leaves_nothing_behind(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")

    def fail_half_way() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_half_way()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file, not a folder")
    path = tmp_path / "taken" / "file.txt"
    with (
        pytest.raises(RunError, match=r"file\.txt"),
        replacing(path) as temporary,
    ):
        temporary.write_text("x")


def test_a_file_is_on_the_disk_before_it_takes_its_place(tmp_path: Path, monkeypatch) -> None:
    in_place: list[bool] = []
    path = tmp_path / "file.txt"
    monkeypatch.setattr(os, "fsync", lambda file: in_place.append(path.exists()))
    write_text(path, "whole")
    assert in_place == [False]


def test_nobody_else_can_read_what_is_being_written(tmp_path: Path) -> None:
    with replacing(tmp_path / "file.txt") as temporary:
        assert temporary.parent.stat().st_mode & 0o777 == 0o700
        temporary.write_text("whole")


def test_only_what_dead_processes_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / f"{TEMPORARY}dead").mkdir()
    (tmp_path / f"{TEMPORARY}dead" / "file.txt").write_text("half")
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / f"{TEMPORARY}dead").mkdir()
    (tmp_path / f"{TEMPORARY}link").symlink_to(tmp_path / "kept")
    with replacing(tmp_path / "a.txt") as temporary:
        assert not (tmp_path / f"{TEMPORARY}dead").exists()
        temporary.write_text("a")
        atomic._swept.clear()
        write_text(tmp_path / "b.txt", "b")
        remove_abandoned(tmp_path)
        assert temporary.read_text() == "a"
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"{TEMPORARY}link", "a.txt", "b.txt", "kept",
    ]  # fmt: skip
    assert list((tmp_path / "kept").iterdir()) == []


def test_names_that_are_not_utf_8_come_back_from_json(tmp_path: Path) -> None:
    text = json.dumps({"name": "\udcff é"}, ensure_ascii=False)
    path = write_text(tmp_path / "file.json", text)
    assert json.loads(path.read_text(encoding="utf-8")) == {"name": "\udcff é"}


def test_a_name_as_long_as_may_be_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / f"a.{'x' * 253}"
    assert write_text(path, "whole").read_text() == "whole"
    with pytest.raises(RunError, match="shorter name"):
        write_text(tmp_path / ("a" * 256), "whole")


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.EACCES, "may write"),
        (errno.EPERM, "may write"),
        (errno.EROFS, "may write"),
        (errno.ENAMETOOLONG, "shorter name"),
        (errno.ENOSPC, "make room"),
    ],
)
def test_an_error_says_what_can_be_done(number: int, remedy: str) -> None:
    message = str(write_error(Path("file.txt"), OSError(number, "reason")))
    for part in ("file.txt", "reason", remedy):
        assert part in message


def test_a_file_that_is_not_there_need_not_be_removed(tmp_path: Path) -> None:
    path = write_text(tmp_path / "file.txt", "whole")
    remove(path)
    remove(path)
    assert not path.exists()
    with pytest.raises(RunError, match="cannot be removed"):
        remove(tmp_path)
