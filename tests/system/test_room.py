from __future__ import annotations

import shutil
from types import SimpleNamespace

import pytest

from mrgs.errors import MrgsWarning
from mrgs.system.room import warn_if_short


def test_too_little_room_is_said_with_both_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=5_000_000))
    warn_if_short(tmp_path / "new" / "run", 4_000_000, "this run")
    with pytest.warns(MrgsWarning, match=r"this run will take about 7.0 GB, .*run has 5.0 MB left"):
        warn_if_short(tmp_path / "new" / "run", 7_000_000_000, "this run")
