"""Folders that nobody else can write to."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

try:
    import grp
    import pwd
except ImportError:  # Windows, whose home folders are the user's own
    grp = pwd = None  # type: ignore[assignment]

ROOT = 0


def require_private(folder: Path, groups: Any = grp, users: Any = pwd) -> None:
    """Make a folder, if it is missing, and check that only this user can change what it holds.

    Neither the folder nor one above it may belong to anyone but this user and root, or be writable
    by others, unless only the owner of a file may move it there, as in ``/tmp``. Whether a group is
    this user's own is asked of the given modules.

    Raises:
        PermissionError: another user can put files there.
        OSError: the folder cannot be made.
    """
    own = folder.resolve()
    for path in (own, *own.parents) if groups is not None else ():
        if path.exists() and not _is_private(path.stat(), path == own, groups, users):
            raise PermissionError(f"{path} can be changed by other users")
    for path in (*reversed(own.parents), own):
        path.mkdir(mode=0o700, exist_ok=True)


def _is_private(status: os.stat_result, is_leaf: bool, groups: Any, users: Any) -> bool:
    if status.st_uid not in (ROOT, os.geteuid()):
        return False
    if status.st_mode & stat.S_ISVTX and not is_leaf:  # files can be moved by their owners alone
        return True
    if status.st_mode & stat.S_IWOTH:
        return False
    return not status.st_mode & stat.S_IWGRP or _is_own_group(status.st_gid, groups, users)


def _is_own_group(group: int, groups: Any, users: Any) -> bool:
    """Whether a group has no member but this user, as those that many systems give each user."""
    try:
        entry, user = groups.getgrgid(group), users.getpwuid(os.geteuid())
    except KeyError:
        return False
    is_shared = any(each.pw_gid == group and each != user for each in users.getpwall())
    return set(entry.gr_mem) <= {user.pw_name} and user.pw_gid == group and not is_shared
