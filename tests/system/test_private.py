from __future__ import annotations

import os
from pathlib import Path

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
    with pytest.raises(PermissionError, match=f"{name} can be changed by other users"):
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
