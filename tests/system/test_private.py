from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from mrgs.system.private import require_private

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="no such permissions here")


def test_a_missing_folder_is_made_for_the_user_alone(tmp_path: Path) -> None:
    require_private(tmp_path / "a" / "b")
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o700
    assert (tmp_path / "a" / "b").stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("name", ["a", "a/b"])
def test_a_folder_that_all_can_write_to_is_refused_and_so_is_what_it_holds(tmp_path, name):
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / name).chmod(0o777)
    with pytest.raises(PermissionError, match=f"{name} "):
        require_private(tmp_path / "a/b")


def test_in_a_sticky_folder_only_owners_move_files(tmp_path):
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a").chmod(0o1777)
    require_private(tmp_path / "a/b")
    with pytest.raises(PermissionError):
        require_private(tmp_path / "a")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs root")
def test_another_users_folder_is_refused_also_behind_a_link(tmp_path):
    (tmp_path / "theirs").mkdir()
    os.chown(tmp_path / "theirs", 65534, 65534)
    (tmp_path / "link").symlink_to(tmp_path / "theirs")
    for name in ("theirs", "link", "link/below"):
        with pytest.raises(PermissionError):
            require_private(tmp_path / name)


def test_what_a_link_leads_to_must_lie_in_private_folders_too(tmp_path):
    (tmp_path / "open/own").mkdir(parents=True)
    (tmp_path / "open").chmod(0o777)
    (tmp_path / "link").symlink_to(tmp_path / "open/own")
    with pytest.raises(PermissionError, match="open "):
        require_private(tmp_path / "link")


@pytest.mark.parametrize(
    ("members", "others", "alone"),
    [([], [], True), (["me"], [], True), (["me", "you"], [], False), ([], ["you"], False)],
)
def test_a_folder_that_a_group_can_write_to_is_private_where_the_user_is_alone_in_it(
    tmp_path, members, others, alone
):
    (tmp_path / "a").mkdir()
    (tmp_path / "a").chmod(0o770)
    group = (tmp_path / "a").stat().st_gid
    users = [SimpleNamespace(pw_name=name, pw_gid=group) for name in ("me", *others)]
    system = (
        SimpleNamespace(getgrgid=lambda _: SimpleNamespace(gr_mem=members)),
        SimpleNamespace(getpwuid=lambda _: users[0], getpwall=lambda: users),
    )
    if alone:
        require_private(tmp_path / "a", *system)
    else:
        with pytest.raises(PermissionError, match="a "):
            require_private(tmp_path / "a", *system)


def test_a_group_that_nobody_knows_is_not_the_users_own(tmp_path):
    def unknown(_):
        raise KeyError

    (tmp_path / "a").mkdir()
    (tmp_path / "a").chmod(0o770)
    with pytest.raises(PermissionError):
        require_private(tmp_path / "a", groups=SimpleNamespace(getgrgid=unknown))


def test_folders_of_root_are_trusted(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    require_private(Path(os.sep))
