from __future__ import annotations

import re

import pytest

from mrgs.errors import MrgsWarning
from mrgs.system.disk import free_disk, warn_if_short


def test_too_little_room_is_said_with_both_numbers(tmp_path):
    folder = tmp_path / "new" / "run"
    warn_if_short(folder, 1, "this run")
    with pytest.warns(MrgsWarning, match="this run") as caught:
        warn_if_short(folder, 10**18, "this run")
    needed, free = re.findall(r"([\d.]+ [MG]B)", str(caught[0].message))
    assert needed == "1000000000.0 GB"
    number, unit = free.split()
    assert float(number) * {"MB": 1e6, "GB": 1e9}[unit] == pytest.approx(free_disk(folder), rel=0.2)
